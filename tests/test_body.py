"""The Body and the hand that drives it; the registry of algorithms."""

import asyncio
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from agents.body import Body, Driver
from agents.registry import ALGORITHMS, algorithm_of
from deploy.inprocess import play
from protocol.errors import AlgorithmError, ScenarioError
from protocol.messages import (
    Briefing,
    Exchange,
    Look,
    Move,
    Sight,
    Stop,
    Wait,
    WaitForNews,
    Write,
)
from tests.play import graph_of, scenario_of
from world_server.terrain import GraphTerrain
from world_server.world import World

SIGHT = Sight(0.0, 0, None, 1, b"", 0, True)


def body_of(robot: int = 0, seed: int = 0) -> Body:
    return Body(Briefing(robot, 3, seed, "test", {}, 888, "global", True))


def driver_of(algorithm: Any) -> Driver:
    return Driver(algorithm, body_of())


def test_one_await_is_one_request() -> None:
    async def all_of_it(body: Body) -> Stop:
        await body.look()
        await body.write(b"t", (b"m",))
        await body.exchange(b"m", b"n")
        await body.move(2)
        await body.move(1, tag=b"t", messages=(b"m",))
        await body.wait()
        await body.wait(2.0, tag=b"t")
        await body.wait_for_news()
        await body.wait_for_news(at_most=3.0, tag=b"t", messages=(b"m",))
        return body.last_words(tag=b"t", messages=(b"m",))

    driver = driver_of(all_of_it)
    requests = [driver.next_request(None if n == 0 else SIGHT) for n in range(10)]
    assert requests == [
        Look(),
        Write(b"t", (b"m",)),
        Exchange(None, (b"m", b"n")),
        Move(None, (), 2),
        Move(b"t", (b"m",), 1),
        Wait(None, (), 1.0),
        Wait(b"t", (), 2.0),
        WaitForNews(None, (), None),
        WaitForNews(b"t", (b"m",), 3.0),
        Stop(b"t", (b"m",)),
    ]


def test_an_await_gives_the_sight() -> None:
    seen: list[Sight] = []

    async def one(body: Body) -> None:
        seen.append(await body.look())

    driver = driver_of(one)
    driver.next_request(None)
    assert driver.next_request(SIGHT) == Stop()
    assert seen == [SIGHT]


def test_a_body_knows_who_it_is() -> None:
    body = body_of(2)
    assert (body.robot, body.team_size) == (2, 3)


class Foreign:
    def __await__(self) -> Generator[str, None, None]:
        yield "something else"


def test_a_foreign_await_names_the_line() -> None:
    async def foreign(body: Body) -> None:
        await body.look()
        await Foreign()

    driver = driver_of(foreign)
    driver.next_request(None)
    line = foreign.__code__.co_firstlineno + 2
    with pytest.raises(AlgorithmError, match=rf"foreign near line {line} .*something else"):
        driver.next_request(SIGHT)


def test_an_event_loop_is_foreign() -> None:
    async def sleeper(body: Body) -> None:
        await asyncio.sleep(0)

    with pytest.raises(AlgorithmError, match="awaits something that is not of its Body"):
        driver_of(sleeper).next_request(None)


async def sleep(body: Body) -> None:
    await body.look()
    await asyncio.sleep(1)


async def sleep_inside(body: Body) -> None:
    async def inner() -> None:
        await asyncio.sleep(1)

    await body.look()
    await inner()


def test_what_looks_for_an_event_loop_names_the_line() -> None:
    for algorithm, lines in ((sleep, 2), (sleep_inside, 5)):
        driver = driver_of(algorithm)
        driver.next_request(None)
        line = algorithm.__code__.co_firstlineno + lines
        words = rf"{algorithm.__name__} near line {line} awaits something .*no running event loop"
        with pytest.raises(AlgorithmError, match=words) as caught:
            driver.next_request(SIGHT)
        assert isinstance(caught.value.__cause__, RuntimeError)


def test_the_inprocess_engine_names_the_line_too() -> None:
    scenario = scenario_of(2)
    world = World(scenario, GraphTerrain(graph_of("01")), [0, 0])
    _, failures = play(scenario, world, sleep)
    line = sleep.__code__.co_firstlineno + 2
    for text in failures.values():
        assert f"AlgorithmError: sleep near line {line} awaits something" in text
    assert failures.keys() == {0, 1}


def test_other_runtime_errors_are_passed_on() -> None:
    async def broken(body: Body) -> None:
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match=r"^mine$"):
        driver_of(broken).next_request(None)
    scenario = scenario_of(1)
    _, failures = play(scenario, World(scenario, GraphTerrain(graph_of("01")), [0]), broken)
    assert failures[0].endswith("\nRuntimeError: mine\n")


def test_a_foreign_await_in_a_function_it_calls_is_found_too() -> None:
    async def inner() -> None:
        await Foreign()

    async def outer(body: Body) -> None:
        await inner()

    with pytest.raises(AlgorithmError, match="outer near line"):
        driver_of(outer).next_request(None)


@pytest.mark.parametrize("value", [0, "done", Look(), False])
def test_an_algorithm_returns_nothing_or_its_last_words(value: object) -> None:
    async def wrong(body: Body) -> object:
        return value

    with pytest.raises(AlgorithmError, match=r"expected None or body\.last_words"):
        driver_of(wrong).next_request(None)


def test_what_an_algorithm_raises_is_passed_on() -> None:
    async def broken(body: Body) -> None:
        await body.look()
        raise KeyError("mine")

    driver = driver_of(broken)
    driver.next_request(None)
    with pytest.raises(KeyError, match="mine"):
        driver.next_request(SIGHT)


def test_only_coroutine_functions_are_driven() -> None:
    def plain(body: Body) -> None:
        pass

    with pytest.raises(AlgorithmError, match="plain is no coroutine function"):
        driver_of(plain)


def test_a_closed_algorithm_never_resumes() -> None:
    reached: list[str] = []

    async def long(body: Body) -> None:
        await body.look()
        reached.append("after")

    driver = driver_of(long)
    driver.next_request(None)
    driver.close()
    assert reached == []


def test_rng_is_repeatable_and_each_robots_own() -> None:
    def draws(robot: int, seed: int) -> list[float]:
        rng = body_of(robot, seed).rng
        return [rng.random() for _ in range(4)]

    assert draws(0, 1) == draws(0, 1)
    assert len({draws(robot, seed)[0] for robot in range(4) for seed in range(4)}) == 16
    assert draws(0, 0)[:1] == [body_of().rng.random()]


# The registry.


@pytest.mark.parametrize("name", ["mr-dfs", "MR-DFS", "mr_dfs"])
def test_an_algorithm_is_found_by_name(name: str) -> None:
    assert isinstance(Driver(algorithm_of(name, {}), body_of()).next_request(None), Look)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"variant": "best"}, "variant"),
        ({"colour": "red"}, "colour"),
        ({"version": 3}, "version"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=f"field `algorithm_options.*{words}"):
        algorithm_of("mr-dfs", options)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mr-dsf", "found 'mr-dsf', expected cocta, cocta-best, mr-dfs, mstc, ncocta, ormstc, "),
        ("", "found ''"),
        (":f", "found ':f'"),
        ("module:", "found 'module:'"),
        ("no_such_module_at_all:f", "cannot import 'no_such_module_at_all'"),
        ("json:no_such_function", "module 'json' has no 'no_such_function'"),
        ("json:dumps", "is no `async def` function"),
    ],
)
def test_a_wrong_name_is_refused(name: str, words: str) -> None:
    with pytest.raises(ScenarioError, match="field `algorithm`") as caught:
        algorithm_of(name, {})
    assert words in str(caught.value)


USERS_MODULE = """
from msgspec import Struct


class Options(Struct, forbid_unknown_fields=True):
    steps: int = 1


async def plain(body):
    await body.look()


async def with_options(body, options: Options):
    for _ in range(options.steps):
        await body.look()


async def with_a_dictionary(body, options):
    for _ in range(options["steps"]):
        await body.look()


async def with_too_much(body, options, more):
    pass


async def without_a_body():
    pass
"""


@pytest.fixture
def users_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    (tmp_path / "canopy_users_module.py").write_text(USERS_MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "canopy_users_module"
    sys.modules.pop("canopy_users_module", None)


@pytest.mark.parametrize(
    ("function", "options", "looks"),
    [
        ("plain", {}, 1),
        ("with_options", {}, 1),
        ("with_options", {"steps": 3}, 3),
        ("with_a_dictionary", {"steps": 2}, 2),
    ],
)
def test_a_function_of_a_user(
    users_module: str, function: str, options: dict[str, Any], looks: int
) -> None:
    driver = Driver(algorithm_of(f"{users_module}:{function}", options), body_of())
    requests = [driver.next_request(None if n == 0 else SIGHT) for n in range(looks + 1)]
    assert requests == [Look()] * looks + [Stop()]


@pytest.mark.parametrize(
    ("function", "options", "words"),
    [
        ("plain", {"steps": 3}, "takes none, found {'steps': 3}"),
        ("with_options", {"steps": "many"}, "found 'many'; expected `int`, got `str`"),
        ("with_options", {"stride": 1}, "stride"),
        ("with_too_much", {}, "takes 3 parameters"),
        ("without_a_body", {}, "takes 0 parameters"),
        ("Options", {}, "is no `async def` function"),
    ],
)
def test_a_wrong_function_of_a_user(
    users_module: str, function: str, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ScenarioError) as caught:
        algorithm_of(f"{users_module}:{function}", options)
    assert words in str(caught.value)


def test_names_are_written_one_way() -> None:
    assert all(name == name.lower().replace("_", "-") for name in ALGORITHMS)
