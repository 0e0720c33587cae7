"""Residual reinforcement learning adds nothing at first, then little, to a policy that stays; a killed run goes on."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file
from support.shared import ENV, trained

from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.policy_actor import load_policy_actor
from lerobot_playbyear.reproduce import residual
from lerobot_playbyear.reproduce.residual import ResidualConfig, ResidualEnv, added, evaluate, learn, make_model

pytest.importorskip("stable_baselines3")
pytestmark = pytest.mark.usefixtures("one_thread")
SHORT = ("--env.episode_length=15",)


def config(folder: Path, **options) -> ResidualConfig:
    """Options of a run on the smallest policy that there is."""
    from lerobot.configs import parser

    given = [f"--policy.path={trained()}", "--policy.device=cpu", *ENV, *SHORT, f"--output_dir={folder}"]
    given += [f"--{name}={value}" for name, value in options.items()]

    @parser.wrap()
    def options_of(cfg: ResidualConfig) -> ResidualConfig:
        return cfg

    before, sys.argv = sys.argv, ["residual", *given]
    try:
        return options_of()
    finally:
        sys.argv = before


def test_what_is_added_is_bounded_and_never_the_grippers():
    action = np.array([0.5, -0.95, 0.0, 0.7], np.float32)
    assert np.array_equal(added(action, np.zeros(3), 0.2), action)
    assert np.allclose(added(action, np.array([5.0, -1.0, 1.0]), 0.2), [0.7, -1.0, 0.2, 0.7])


def test_before_it_learned_it_acts_as_the_policy_does(tmp_path):
    cfg = config(tmp_path)
    env = ResidualEnv(env_spec(cfg.env).make(), load_policy_actor(cfg.policy, cfg.env), cfg.bound)
    model = make_model(cfg, env)
    seen, _ = env.reset(seed=50000)
    assert env.observation_space.contains(seen)
    for _ in range(5):
        residual_action = model.predict(seen, deterministic=True)[0]
        assert np.array_equal(residual_action, np.zeros(3, np.float32))
        seen, *_ = env.step(residual_action)
    explored = np.stack([model.predict(seen, deterministic=False)[0] for _ in range(50)])
    assert 0.01 < explored.std() < 0.1, "it explores near the policy"


def test_it_is_judged_on_the_episodes_that_it_is_told(tmp_path):
    learned, attempts = learn(config(tmp_path, steps=20, warmup_steps=10, batch_size=4)), tmp_path / "attempts.jsonl"
    judged = {"residual": learned, "seed": 50000, "n_episodes": 2, "env.attempts_file": attempts}
    evaluate(config(tmp_path / "judged", **judged))
    assert [json.loads(line)["seed"] for line in attempts.read_text().splitlines()] == [50000, 50001]


def test_the_actor_waits_for_the_critic_and_a_run_goes_on_where_it_was_killed(tmp_path, monkeypatch):
    options = {"steps": 40, "warmup_steps": 10, "batch_size": 4}
    weights = []
    kept = residual._kept

    def note(model):
        weights.append((model.num_timesteps, {name: value.clone() for name, value in model.actor.state_dict().items()}))
        if len(weights) == 6:
            raise KeyboardInterrupt
        return kept(model)

    monkeypatch.setattr(residual, "_kept", note)
    with pytest.raises(KeyboardInterrupt):
        learn(config(tmp_path, **options))
    assert [steps for steps, _ in weights] == [4, 8, 12, 16, 20, 24]
    first, last = weights[0][1], weights[-1][1]
    assert all((first[name] == weights[3][1][name]).all() for name in first), "at 16 steps the critic alone has learned"
    assert any((first[name] != last[name]).any() for name in first)
    folder = learn(config(tmp_path, **options))
    assert [steps for steps, _ in weights[6:]] == [24, 28, 32, 36, 40]
    assert load_file(folder / "model.safetensors").keys() == first.keys()


def test_with_other_steps_it_goes_on_and_forgets_nothing(tmp_path, monkeypatch):
    n_remembered = []
    kept = residual._kept

    def note(model):
        n_remembered.append(model.replay_buffer.size())
        return kept(model)

    monkeypatch.setattr(residual, "_kept", note)
    for steps in (20, 30, 10):  # it fills the first memory, leaves room in the second, is too much for the third
        learn(config(tmp_path, steps=steps, warmup_steps=10, batch_size=4))
    assert n_remembered[-5:] == [20, 23, 26, 29, 30]
