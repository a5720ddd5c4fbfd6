"""Key expressions: built and parsed here and nowhere else.

    canopy/RUN/world/in/robot/3/NONCE     requests of robot 3                   robot 3 -> world
    canopy/RUN/world/in/robot/3/NONCE/failed   its algorithm has failed         robot 3 -> world
    canopy/RUN/world/in/supervisor        what the supervisor knows             supervisor -> world
    canopy/RUN/world/in/bookkeeping       replies of the store                  bookkeeping -> world
    canopy/RUN/world/in/wake              a reminder to itself                  world -> world
    canopy/RUN/world/join/3               query: join as robot 3                robot 3 -> world
    canopy/RUN/robot/3/NONCE/reply        replies to robot 3                    world -> robot 3
    canopy/RUN/bookkeeping/in             batches and questions                 world -> bookkeeping
    canopy/RUN/supervisor/in              kill orders, progress, the end        world -> supervisor
    canopy/RUN/alive/robot/3/NONCE        liveliness token of robot 3

Everything the world must hear comes under one prefix, so that one subscriber hears it in order.
"""

import re

from msgspec import Struct

from protocol.errors import MessageError

RUN_NAME = re.compile(r"[A-Za-z0-9_.-]+")
_ROBOT = re.compile(r"(\d+)/([0-9a-f]+)(/failed)?")


class Keys(Struct, frozen=True):
    """All keys of one run.

    Attributes:
        run: name of the run; letters, digits, ``_``, ``.`` and ``-``.
    """

    run: str

    @property
    def root(self) -> str:
        """What all keys of the run begin with."""
        return f"canopy/{self.run}"

    @property
    def world_in(self) -> str:
        """All that the world hears."""
        return f"{self.root}/world/in/**"

    def requests(self, robot: int | str, nonce: str = "*") -> str:
        """Requests of a robot."""
        return f"{self.root}/world/in/robot/{robot}/{nonce}"

    def failed(self, robot: int | str, nonce: str = "*") -> str:
        """Word of a robot that its algorithm has failed, in place of a request."""
        return f"{self.requests(robot, nonce)}/failed"

    @property
    def supervisor_reports(self) -> str:
        """What the supervisor tells the world."""
        return f"{self.root}/world/in/supervisor"

    @property
    def store_replies(self) -> str:
        """What the store answers the world."""
        return f"{self.root}/world/in/bookkeeping"

    @property
    def wake(self) -> str:
        """What the world reminds itself by."""
        return f"{self.root}/world/in/wake"

    def join(self, robot: int | str) -> str:
        """The query by which a process becomes a robot."""
        return f"{self.root}/world/join/{robot}"

    def replies(self, robot: int | str, nonce: str = "*") -> str:
        """Replies to a robot."""
        return f"{self.root}/robot/{robot}/{nonce}/reply"

    @property
    def store_requests(self) -> str:
        """What the world asks of the store."""
        return f"{self.root}/bookkeeping/in"

    @property
    def world_reports(self) -> str:
        """What the world tells the supervisor."""
        return f"{self.root}/supervisor/in"

    def alive(self, robot: int | str = "*", nonce: str = "*") -> str:
        """Liveliness token of a robot."""
        return f"{self.root}/alive/robot/{robot}/{nonce}"

    def sender(self, key: str) -> tuple[str, int, str]:
        """Tell who sent what came on a key under `world_in`, or announced a token under `alive`.

        Returns:
            ``("robot", id, nonce)``, ``("failed", id, nonce)``, or another kind of sender with -1 and
            an empty nonce.

        Raises:
            MessageError: If the key is none of this run.
        """
        for prefix in (f"{self.root}/world/in/", f"{self.root}/alive/"):
            if key.startswith(prefix):
                kind, _, rest = key[len(prefix) :].partition("/")
                match = _ROBOT.fullmatch(rest)
                if kind == "robot" and match:
                    return "failed" if match[3] else kind, int(match[1]), match[2]
                if kind in ("supervisor", "bookkeeping", "wake") and not rest:
                    return kind, -1, ""
        raise MessageError(f"key {key!r} is none of run {self.run!r}")

    def joining(self, key: str) -> int:
        """Return the robot that a join query is for.

        Raises:
            MessageError: If the key is no join of this run.
        """
        prefix = f"{self.root}/world/join/"
        number = key.removeprefix(prefix)
        if not key.startswith(prefix) or not number.isdecimal():
            raise MessageError(f"key {key!r} is no join of run {self.run!r}")
        return int(number)
