"""Steps per second of the environments, against EnvPool, Gymnasium and Gymnasium-MuJoCo."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.floor import Holds, Kernels, nothing, products
from benchmarks.measure import EXTRA, Contestant, Effort, Times, installed, on_cores, side_by_side, tell
from benchmarks.peak import gain_of_two, multiply_adds
from benchmarks.policies import POLICIES, Policy, Script, make_batch, script
from benchmarks.table import LeftOut, Limit, Line, Row
from magenv import ENV_ID
from magenv.episodes import Settings

TITLE = "Environment"

BASE = "N = 2, 4 Hz, approach-60"
MOVING = "N = 2, 4 Hz, approach-60, plant moving"
CASES = {
    BASE: Settings("approach-60", n_epm=2, control_hz=4.0),
    "N = 3, 4 Hz, approach-60": Settings("approach-60", n_epm=3, control_hz=4.0),
    MOVING: Settings("approach-60", plant="moving", n_epm=2, control_hz=4.0),
    "N = 2, 2 Hz, approach-60": Settings("approach-60", n_epm=2, control_hz=2.0),
    "N = 2, 4 Hz, random": Settings("random", n_epm=2, control_hz=4.0),
}
"""4 Hz are 50 substeps of 5 ms, 2 Hz are 100."""
SUBSTEPS = 50
"""Of ``BASE``."""
PEAK = "peak of one core"
HOLD = "a hold alone"
EPISODE = 400
"""Steps of an episode under control at 4 Hz: the record of one is played again and again."""
HELD = {"N = 3, 4 Hz, approach-60", MOVING}
"""Cases that must reach half of the speed of ``BASE``."""
TURN_S, FEWEST_STEPS = 1.0, 4
"""A turn lasts about this long at most, and has so many steps at least."""
ENVPOOL_BATCHES = (256, 512, 1024, 16384)
"""Batch sizes of EnvPool beside our own, the best of which counts."""


class Batch:
    """A batched environment and the actions it is stepped with: all of them, or as many as fit into a turn."""

    def __init__(self, given: Script, envs: int, threads: int = 1) -> None:
        self._env: Any = make_batch(given.settings, envs, threads)  # Gymnasium types ``seed`` as a single number
        self._given, self._envs, self._threads = given, envs, threads
        self._actions = given.actions[:1]
        self.reset()
        self.run()  # compiles
        with on_cores(threads):
            before = time.perf_counter()
            self.run()
            took = time.perf_counter() - before
        self._actions = given.actions[: max(int(TURN_S / took), FEWEST_STEPS)]

    def reset(self) -> None:
        """Begin the scripted episodes."""
        self._env.reset(seed=self._given.seeds)

    def run(self) -> None:
        """Play the script."""
        for actions in self._actions:
            self._env.step(actions)

    def contestant(self) -> Contestant:
        """Return this batch as a contestant."""
        return Contestant(self.run, len(self._actions) * self._envs, self.reset, self._threads)

    def observed(self) -> tuple[float, float]:
        """Play the script once; return resets and integrator substeps per step."""
        self.reset()
        resets = substeps = 0
        for actions in self._actions:
            _, _, terminated, truncated, info = self._env.step(actions)
            ended = terminated | truncated
            last = info["final_info"]["substeps"] if ended.any() else 0
            resets += int(ended.sum())
            substeps += int(np.where(ended, last, info["substeps"]).sum())
        steps = len(self._actions) * self._envs
        return resets / steps, substeps / steps


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part."""
    yield from _threads(effort)
    yield from _batches(effort)
    yield from _scalar(effort)


def _threads(effort: Effort) -> Iterator[Row]:
    """Two threads against one; first of all, so that the threads are born free to use both cores."""
    what = f"two threads against one, {BASE}, control"
    given = script("control", CASES[BASE], effort.envs, effort.steps, effort.recorded)
    contestants = {}
    for name, threads in (("two", 2), ("one", 1)):
        contestants[name] = Batch(given, effort.envs, threads).contestant()
        contestants[f"{name} of the machine"] = multiply_adds(threads)
    times = side_by_side(contestants, effort.repeats)
    note = gain_of_two(times.speedup("two of the machine", "one of the machine"))
    ratio = times.speedup("two", "one")
    yield Row(what, times.rate("two"), "steps/s", "one thread", times.rate("one"), ratio, Limit(1.7), note)


def _batches(effort: Effort) -> Iterator[Line]:
    """All cases under all policies, and the peers, in one contest."""
    contestants: dict[str, Contestant] = {}
    notes: dict[str, str] = {}
    for case, settings in CASES.items():
        for policy in POLICIES:
            tell(f"actions: {case}, {policy}")
            batch = Batch(script(policy, settings, effort.envs, effort.steps, effort.recorded), effort.envs)
            name = _name(case, policy)
            contestants[name] = batch.contestant()
            resets, substeps = batch.observed()
            notes[name] = f"per step {resets:.2g} resets, {substeps:.3g} substeps"
    contestants |= dict(_vector_peers(effort)) | {PEAK: multiply_adds(1)}
    contestants[HOLD] = Holds(CASES[BASE], effort.envs, effort.steps).contestant()
    times = side_by_side(contestants, effort.repeats)
    for policy in POLICIES:
        yield from _against_peers(times, policy, notes[_name(BASE, policy)])
    yield from _bounds(times)
    for case in CASES:
        for policy in POLICIES if case != BASE else ():
            name, base = _name(case, policy), _name(BASE, policy)
            yield Row(
                name,
                times.rate(name),
                "steps/s",
                BASE,
                times.rate(base),
                times.speedup(name, base),
                Limit(0.5) if case in HELD else None,
                notes[name],
            )
    for package, what in (("envpool", "EnvPool CartPole-v1"), ("mujoco", "Gymnasium HalfCheetah-v5")):
        if not installed(package):
            yield LeftOut(what, f"{package} is not installed: {EXTRA}")


def _name(case: str, policy: Policy) -> str:
    return f"make_vec, {case}, {policy}"


def _against_peers(times: Times, policy: Policy, note: str) -> Iterator[Row]:
    name = _name(BASE, policy)
    peers: dict[str, Limit | None] = {}
    if installed("envpool"):
        peers = dict.fromkeys((times.fastest("EnvPool"), "EnvPool CartPole, same envs"), Limit(1.5))
    peers |= {"HalfCheetah-v5": Limit(50.0), "Gymnasium CartPole": None}
    for peer, limit in peers.items():
        if peer in times.of:
            ratio = times.speedup(name, peer)
            yield Row(name, times.rate(name), "steps/s", peer, times.rate(peer), ratio, limit, note)


def _bounds(times: Times) -> Iterator[Row]:
    """How fast a step would be that had nothing but its hold, or its products at the peak measured beside it."""
    each = products(CASES[BASE])
    flops = 2.0 * each * SUBSTEPS  # that of a product and a sum
    for peer in ("EnvPool CartPole, same envs", "HalfCheetah-v5"):
        if peer in times.of:
            ratio, note = (
                times.speedup(HOLD, peer),
                f"{SUBSTEPS} substeps; no command, observation, reward, info, reset",
            )
            yield Row(f"{HOLD}, {BASE}", times.rate(HOLD), "steps/s", peer, times.rate(peer), ratio, note=note)
            bound, ratio = times.rate(PEAK) / flops, times.speedup(PEAK, peer) / flops
            note = f"{each} a substep, {SUBSTEPS} substeps, at the peak of multiply-adds; no other work at all"
            yield Row(f"products of a hold alone, {BASE}", bound, "steps/s", peer, times.rate(peer), ratio, note=note)


def _vector_peers(effort: Effort) -> Iterator[tuple[str, Contestant]]:
    """Others' environments with random actions: a turn each of about as many steps as are done in half a second."""
    rng = np.random.default_rng(0)
    if installed("envpool"):
        for envs in (effort.envs, *ENVPOOL_BATCHES):
            name = "EnvPool CartPole, same envs" if envs == effort.envs else f"EnvPool CartPole, {envs} envs"
            steps = max(effort.steps * effort.envs // envs, 1)
            yield name, _stepped(_envpool(envs), rng.integers(0, 2, (steps, envs)), envs)
    cartpole = gymnasium.make_vec("CartPole-v1", num_envs=effort.envs, vectorization_mode="vector_entry_point")
    cartpole.reset(seed=0)
    actions = rng.integers(0, 2, (effort.steps, effort.envs))
    yield "Gymnasium CartPole", _stepped(cartpole, actions, effort.envs)
    if installed("mujoco"):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # MuJoCo writes a log where it stands
            cheetah = gymnasium.make("HalfCheetah-v5", disable_env_checker=True)
        yield "HalfCheetah-v5", _single(cheetah, rng.uniform(-1.0, 1.0, (effort.scalar_steps // 2, 6)))


def _envpool(envs: int) -> Any:
    import envpool

    logging.getLogger("envpool").setLevel(logging.ERROR)
    with on_cores(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pool = envpool.make("CartPole-v1", env_type="gymnasium", num_envs=envs, num_threads=1)
        pool.reset()
    return pool


def _stepped(env: Any, actions: NDArray[Any], envs: int) -> Contestant:
    def run() -> None:
        for action in actions:
            env.step(action)

    return Contestant(run, len(actions) * envs)


def _single(env: gymnasium.Env[Any, Any], actions: NDArray[Any], seed: int | None = None) -> Contestant:
    """Return a scalar environment that is stepped with the actions, and reset wherever an episode ends."""

    def run() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset(seed=seed)

    return Contestant(run, len(actions), lambda: env.reset(seed=0))


def _scalar(effort: Effort) -> Iterator[Row]:
    """One environment at a time through ``gymnasium.make``, and what none of them can go below."""
    steps = effort.scalar_steps
    cartpole = gymnasium.make("CartPole-v1", disable_env_checker=True)
    contestants = {"CartPole-v1": _single(cartpole, np.random.default_rng(0).integers(0, 2, steps))}
    limits: dict[str, Limit | None] = {}
    for policy in POLICIES:
        given = script(policy, CASES[BASE], 1, min(steps, EPISODE), 1)
        actions = np.resize(given.actions[:, 0], (steps, *given.actions.shape[2:]))
        env = gymnasium.make(ENV_ID, disable_env_checker=True, **asdict(given.settings))
        name = f"make, {BASE}, {policy}"
        contestants[name], limits[name] = _single(env, actions, seed=0 if policy == "control" else None), Limit(1.3)
        if policy == "control":
            floor = {"make, an env that does nothing": _single(nothing(), actions)}
            floor[f"a step's kernels without Python, {BASE}, {policy}"] = Kernels(given.settings, actions).contestant()
    contestants |= floor
    times = side_by_side(contestants, effort.repeats)
    for name, limit in (limits | dict.fromkeys(floor)).items():
        peer = "CartPole-v1"
        ratio = times.speedup(name, peer)
        yield Row(name, times.rate(name), "steps/s", f"Gymnasium {peer}", times.rate(peer), ratio, limit)
