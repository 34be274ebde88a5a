"""Models as environments of gymnasium, one or many at once.

Reward and end are expressions of the language, compiled with the model and checked for their units, or functions of
Python.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from fric import _fric, _values
from fric._model import Model, Text
from fric.errors import RunError, unknown

__all__ = ["Env", "VectorEnv"]

_REWARD, _DONE = "reward_of_environment", "end_of_environment"

#: Makes start values of states, by path, from a generator of random numbers.
Start = Callable[[np.random.Generator], Mapping[str, float]]
#: Reward or end, from observations and actions.
Function = Callable[[np.ndarray, np.ndarray], Any]


class _Plan:
    """What both kinds of environments share."""

    def __init__(
        self,
        model: Model,
        action: Sequence[str],
        observe: Sequence[str],
        reward: str | Function,
        done: str | Function | None,
        period: str | float,
        step: str | float,
        method: str,
    ):
        lines = []
        if isinstance(reward, str):
            lines.append(f"  output {_REWARD} [1] = {reward}")
        if isinstance(done, str):
            lines.append(f"  output {_DONE} [1] = if {done} then 1 else 0")
        if lines:
            inner = model.text._inner
            name, _ = inner.source()
            text = inner.extended(model.name, "\n".join(lines))
            assert text is not None, "the model is one of the text"
            model = Text(_fric.Text(name, text, inner.files())).model(model.name, **model._values)
        self.model, self.reward, self.done = model, reward, done
        self.action, self.observe = list(action), list(observe)
        h, period = _values.seconds("step", step), _values.seconds("period", period)
        self.count = round(period / h)
        if self.count < 1 or abs(self.count * h / period - 1) > 1e-9:
            raise ValueError(f"period: {period} s is no multiple of the step of {h} s")
        self.extra = [name for name, of in ((_REWARD, reward), (_DONE, done)) if isinstance(of, str)]
        self.how: dict[str, Any] = {
            "step": h,
            "method": method,
            "inputs": self.action,
            "outputs": [*self.observe, *self.extra],
        }

    def space(self, paths: Sequence[str], known: Mapping[str, Any], what: str) -> gymnasium.spaces.Box:
        """A box of the declared ranges, in SI."""
        for path in paths:
            if path not in known:
                raise unknown(what, path, list(known))
        low, high = (np.array([known[path].range[side] for path in paths], dtype=float) for side in (0, 1))
        return gymnasium.spaces.Box(low, high, dtype=np.float64)

    def spaces(self) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
        """Those of actions and observations. A model has no ranges for values that it only computes."""
        model = self.model
        seen = {**model.inputs, **model.params, **model.states, **model.outputs}
        for path in self.observe:
            if path not in seen:
                raise unknown("quantity to observe", path, list(seen))
        return self.space(self.action, model.inputs, "input"), self.space(self.observe, seen, "quantity to observe")

    def split(self, rows: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observations, rewards and ends of rows of outputs."""
        n = len(self.observe)
        seen = rows[:, :n]
        extra = {name: rows[:, n + k] for k, name in enumerate(self.extra)}

        def of(function: str | Function | None, name: str) -> np.ndarray:
            if function is None:
                return np.zeros(len(rows))
            if isinstance(function, str):
                return extra[name]
            return np.array([function(one, action) for one, action in zip(seen, actions)], dtype=float)

        return seen, of(self.reward, _REWARD), of(self.done, _DONE) > 0


class Env(gymnasium.Env):
    """An environment of a model.

    ``action``: inputs, held for each ``period``. ``observe``: states and outputs. An instance that leaves a range ends
    its episode; ``info["error"]`` says why. ``limit``: steps after which an episode is truncated.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self,
        model: Model,
        *,
        action: Sequence[str],
        observe: Sequence[str],
        reward: str | Function,
        done: str | Function | None = None,
        period: str | float,
        step: str | float,
        method: str = "expo",
        limit: int | None = None,
        start: Start | None = None,
    ):
        self._plan = _Plan(model, action, observe, reward, done, period, step, method)
        self.action_space, self.observation_space = self._plan.spaces()
        self._limit, self._start = limit, start
        self._stepper = self._plan.model.start(**self._plan.how)
        self._seen = self._observed()
        self._steps = 0

    def _observed(self) -> np.ndarray:
        return np.array([self._stepper[path] for path in self._plan.observe])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._stepper.reset()
        if self._start is not None:
            paths = self._stepper.states
            state = dict(zip(paths, self._stepper.state))
            for path, value in self._start(self.np_random).items():
                if path not in state:
                    raise unknown("state", path, paths)
                state[path] = _values.number(path, value, self._plan.model.states[path].si)
            self._stepper.state = np.array(list(state.values()), dtype=float)
        self._steps = 0
        self._seen = self._observed()
        return self._seen, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action = np.asarray(action, dtype=float).reshape(-1)
        self._steps += 1
        truncated = self._limit is not None and self._steps >= self._limit
        try:
            found = self._stepper.hold(self._plan.count, *action)
        except RunError as error:
            return self._seen, 0.0, True, truncated, {"error": str(error), "time": error.time}
        row = np.array(found, dtype=float).reshape(1, -1)
        seen, reward, ended = self._plan.split(row, action[None])
        self._seen = seen[0]
        return self._seen, float(reward[0]), bool(ended[0]), truncated, {"time": self._stepper.time}


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many environments of a model, stepped together by a batch: each as :class:`Env`."""

    def __init__(
        self,
        model: Model,
        num_envs: int,
        *,
        action: Sequence[str],
        observe: Sequence[str],
        reward: str | Function,
        done: str | Function | None = None,
        period: str | float,
        step: str | float,
        method: str = "expo",
        limit: int | None = None,
        start: Start | None = None,
        threads: int = 1,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    ):
        self._plan = plan = _Plan(model, action, observe, reward, done, period, step, method)
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset_mode}
        self.num_envs, self._limit, self._start, self._mode = num_envs, limit, start, autoreset_mode
        self.single_action_space, self.single_observation_space = plan.spaces()
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self._batch = plan.model.batch(num_envs, threads=threads, **plan.how)
        self._steps = np.zeros(num_envs, dtype=int)
        self._over = np.zeros(num_envs, dtype=bool)
        self._seen = self._observed()

    def _observed(self) -> np.ndarray:
        return np.column_stack([self._batch[path] for path in self._plan.observe])

    def _restart(self, mask: np.ndarray) -> None:
        self._batch.reset(mask)
        self._steps[mask], self._over[mask] = 0, False
        if self._start is not None:
            state, paths = self._batch.state, self._batch.states
            for k in np.flatnonzero(mask):
                for path, value in self._start(self._generators[k]).items():
                    if path not in paths:
                        raise unknown("state", path, paths)
                    state[k, paths.index(path)] = _values.number(path, value, self._plan.model.states[path].si)
            self._batch.state = state
        self._seen = np.where(mask[:, None], self._observed(), self._seen)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        mask = np.ones(self.num_envs, dtype=bool)
        if options and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"], dtype=bool)
        if seed is not None or not hasattr(self, "_generators"):
            seeds = [None if seed is None else seed + k for k in range(self.num_envs)] if not isinstance(
                seed, Sequence
            ) else list(seed)
            self._generators = [gymnasium.utils.seeding.np_random(one)[0] for one in seeds]
        self._restart(mask)
        return self._seen.copy(), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        actions = np.ascontiguousarray(actions, dtype=float).reshape(self.num_envs, -1)
        renewed = np.zeros(self.num_envs, dtype=bool)
        if self._mode == AutoresetMode.NEXT_STEP and self._over.any():
            renewed = self._over.copy()
        elif self._mode == AutoresetMode.DISABLED and self._over.any():
            raise ValueError("environments have ended: call reset(options={'reset_mask': …}) first")
        rows = self._batch.hold(self._plan.count, actions).reshape(self.num_envs, -1)
        failed = self._batch.failed
        seen, reward, ended = self._plan.split(rows, actions)
        # One that left a range keeps what was observed last.
        self._seen = np.where(failed[:, None], self._seen, seen)
        reward = np.where(failed, 0.0, reward)
        ended = ended | failed
        self._steps += 1
        truncated = np.full(self.num_envs, False) if self._limit is None else self._steps >= self._limit
        info: dict[str, Any] = {}
        for k in np.flatnonzero(failed & ~renewed):
            info.setdefault("error", np.full(self.num_envs, None, dtype=object))[k] = self._batch.why(int(k))
        if renewed.any():
            # The first step after the end of an episode only starts the next one.
            self._restart(renewed)
            reward, ended, truncated = (np.where(renewed, 0, one).astype(one.dtype) for one in (reward, ended, truncated))
        self._over = ended | truncated
        if self._mode == AutoresetMode.SAME_STEP and self._over.any():
            info["final_obs"] = np.full(self.num_envs, None, dtype=object)
            for k in np.flatnonzero(self._over):
                info["final_obs"][k] = self._seen[k].copy()
            info["_final_obs"] = self._over.copy()
            self._restart(self._over.copy())
            return self._seen.copy(), reward, ended, truncated, info
        return self._seen.copy(), reward, ended, truncated, info
