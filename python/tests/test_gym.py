"""Environments pass gymnasium's own checks, and many at once are one by one."""

import numpy as np
import pytest

import fric

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from fric.gym import Env, VectorEnv  # noqa: E402

TEXT = """model Cart {
  input  u [N] in -5 N .. 5 N
  param  m = 1 kg in > 0
  state  x [m]   = 0 in -3 m .. 3 m
  state  v [m/s] = 0 in -9 m/s .. 9 m/s
  dx/dt = v
  dv/dt = (u - 0.1 N*s/m * v) / m
}
"""
HOW = {
    "action": ["u"],
    "observe": ["x", "v"],
    "reward": "-(x - 1 m)^2 / 1 m^2",
    "done": "abs(x) > 2 m",
    "period": "10 ms",
    "step": "1 ms",
}


def start(random):
    return {"x": random.uniform(-0.5, 0.5)}


def test_gymnasium_accepts_it():
    check_env(Env(fric.loads(TEXT).model("Cart"), limit=50, start=start, **HOW), skip_render_check=True)


def test_reward_and_end_are_expressions_or_functions():
    model = fric.loads(TEXT).model("Cart", m="2 kg")
    env, same = Env(model, **HOW), Env(
        model,
        **{**HOW, "reward": lambda seen, action: -((seen[0] - 1) ** 2), "done": lambda seen, action: abs(seen[0]) > 2},
    )
    env.reset(seed=1), same.reset(seed=1)
    for _ in range(1000):
        seen, reward, ended, cut, _ = env.step([5.0])
        twice = same.step([5.0])
        assert (seen == twice[0]).all() and reward == pytest.approx(twice[1]) and ended == twice[2] and not cut
        if ended:
            break
    assert ended and abs(seen[0]) > 2
    with pytest.raises(fric.CompileError, match="E0101"):
        Env(model, **{**HOW, "reward": "x + v"})
    with pytest.raises(fric.UnknownName):
        Env(model, **{**HOW, "action": ["w"]})
    with pytest.raises(ValueError, match="no multiple"):
        Env(model, **{**HOW, "period": "1.5 ms"})


def test_leaving_a_range_ends_an_episode():
    env = Env(fric.loads(TEXT).model("Cart", m="1 g"), **{**HOW, "done": None})
    env.reset()
    for _ in range(100):
        _, _, ended, _, info = env.step([5.0])
        if ended:
            break
    assert ended and "left its range" in info["error"]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_many_are_one_by_one(mode, seed):
    """Mutants tried by hand, each fails with seed 1: the generator of one environment serves all; the step that starts an
    episode has the reward of the last one; the end of one restarts all.
    """
    model, n = fric.loads(TEXT).model("Cart"), 5
    many = VectorEnv(model, n, limit=110, start=start, autoreset_mode=mode, threads=2, **HOW)
    ones = [Env(model, limit=110, start=start, **HOW) for _ in range(n)]
    seen, _ = many.reset(seed=seed)
    for k, one in enumerate(ones):
        assert (one.reset(seed=seed + k)[0] == seen[k]).all()
    random, over, episodes = np.random.default_rng(seed), np.zeros(n, dtype=bool), 0
    apart = 0
    for _ in range(700):
        actions = random.uniform(2, 5, (n, 1))
        if mode == AutoresetMode.DISABLED and over.any():
            seen, _ = many.reset(options={"reset_mask": over})
            for k in np.flatnonzero(over):
                assert (ones[k].reset()[0] == seen[k]).all()
            over[:] = False
        seen, reward, ended, cut, info = many.step(actions)
        for k, one in enumerate(ones):
            if over[k]:
                expected = (one.reset()[0], 0.0, False, False)
            else:
                expected = one.step(actions[k])[:4]
            if (expected[2] or expected[3]) and mode == AutoresetMode.SAME_STEP:
                assert (info["final_obs"][k] == expected[0]).all()
                expected = (one.reset()[0], *expected[1:])
            assert (seen[k] == expected[0]).all() and (reward[k], ended[k], cut[k]) == expected[1:]
        over = ended | cut if mode != AutoresetMode.SAME_STEP else np.zeros(n, dtype=bool)
        episodes += int((ended | cut).sum())
        apart += int(0 < (ended | cut).sum() < n)
    assert episodes > 10 and apart > 5, "they end at different instants"
