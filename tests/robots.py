"""Robot algorithms of users, as the tests of whole runs name them: ``tests.robots:wanderer``."""

import asyncio

from agents.body import Body


async def wanderer(body: Body) -> None:
    """Walk about at random for a dozen steps, without any device."""
    here = await body.look()
    for _ in range(12):
        here = await body.move(body.rng.randrange(here.degree))
        if body.rng.random() < 0.3:
            here = await body.wait(float(body.rng.randint(1, 3)))


async def talker(body: Body) -> None:
    """Walk, say so, and wait for what the others say."""
    here = await body.look()
    for step in range(5):
        here = await body.move(step % here.degree, messages=(bytes([body.robot, step]),))
        here = await body.exchange(b"here")
        here = await body.wait_for_news(at_most=2.0)
        here = await body.write(bytes([len(here.inbox), len(here.losses), len(here.here)]))


async def waits_for_ever(body: Body) -> None:
    """Wait for news that never come."""
    here = await body.look()
    if body.robot == 0:
        await body.move(here.degree - 1)
    await body.wait_for_news()


async def raises(body: Body) -> None:
    """Fail, as robot 1, in its third request."""
    here = await body.look()
    for step in range(4):
        if body.robot == 1 and step == 2:
            raise ValueError("robot 1 has a bug")
        here = await body.move(step % here.degree)


async def leaves_the_interpreter(body: Body) -> None:
    """Fail, as robot 1, by a call of exit."""
    here = await body.look()
    if body.robot == 1:
        raise SystemExit(0)
    await body.move(here.degree - 1)


async def awaits_a_stranger(body: Body) -> None:
    """Await, as robot 1, what is not of its Body."""

    class Stranger:
        def __await__(self):
            yield "nothing of a Body's"

    here = await body.look()
    if body.robot == 1:
        await Stranger()
    await body.move(here.degree - 1)


async def sleeps(body: Body) -> None:
    """Await, as robot 1, what asks for an event loop."""
    here = await body.look()
    if body.robot == 1:
        await asyncio.sleep(1)
    await body.move(here.degree - 1)


async def takes_no_exit(body: Body) -> None:
    """Break a rule, as robot 1: there is no such exit."""
    here = await body.look()
    await body.move(99 if body.robot == 1 else here.degree - 1)


async def writes_too_much(body: Body) -> None:
    """Break a rule, as robot 1: the tag does not fit."""
    here = await body.look()
    if body.robot == 1:
        await body.write(bytes(1000))
    await body.move(here.degree - 1)


async def goes_in_rounds(body: Body) -> None:
    """Break a rule, as robots 0 and 1: they never let the instant end."""
    here = await body.look()
    while body.robot < 2:
        here = await body.exchange()
    await body.move(here.degree - 1)


async def moves_by_name(body: Body) -> None:
    """Ask, as robot 1, for what is no request at all: an exit that is text."""
    here = await body.look()
    await body.move("north" if body.robot == 1 else here.degree - 1)  # type: ignore[arg-type]


async def waits_whole_numbers(body: Body) -> None:
    """Wait for an int of ticks, which is as good as a float."""
    await body.look()
    await body.wait(2)
