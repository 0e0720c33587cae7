"""HG-DAgger: attempts, what is recorded of them, rounds, checkpoints that LeRobot's commands take."""

import sys
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from dagger_factory import (
    ENV,
    QUICK,
    arguments,
    base_folder,
    column,
    command,
    corrections,
    dagger,
    metrics,
    seeds,
    state,
)
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_eval, lerobot_train
from lerobot.scripts.lerobot_eval import rollout
from safetensors.torch import load_file

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger import Expert, ExpertConfig, Verdict
from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.dagger.methods import Method
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of three kept attempts with an evaluation before, after the second round, and at the end."""
    folder = tmp_path_factory.mktemp("dagger")
    seed = "--episode_seed=10007"  # of the next seed, 10011, the task's own expert makes something, and few of those before
    dagger(folder, *QUICK, seed, "--episodes=3", "--warmup_episodes=2", "--eval_every=2", "--eval.n_episodes=1")
    return folder


# Attempts


class Scripted(Expert):
    """Takes over in chosen steps, asks the task's expert what to do, and remembers it."""

    def __init__(self, steps=(), verdicts=None):
        self.steps, self.verdicts = steps, verdicts or {}

    def reset(self, env):
        self.n, self.actions = -1, {}
        self.script = env.unwrapped.scripted_expert()

    def wants_control(self, observation, policy_action):
        self.n += 1
        self.wanted = self.script.act()
        return self.n in self.steps

    def act(self):
        self.actions[self.n] = self.wanted
        return self.wanted

    def verdict(self):
        return self.verdicts.get(self.n)


def scene(expert=None, n_steps=40):
    env_cfg = PlaybyearEnvConfig(image_size=16, episode_length=n_steps)
    policy = PlaybyearPolicy.from_pretrained(base_folder() / "policy")
    processors = make_pre_post_processors(policy.config, str(base_folder() / "policy"))
    return env_spec(env_cfg).make(), PolicyActor(policy, env_cfg, *processors), expert or Scripted()


def test_a_policy_acts_as_in_lerobots_rollout():
    env, actor, expert = scene()
    episode = play(env, actor, seed=5, expert=expert)
    env_cfg = PlaybyearEnvConfig(image_size=16, episode_length=40)
    policy = PlaybyearPolicy.from_pretrained(base_folder() / "policy").eval()
    own = make_pre_post_processors(policy.config, str(base_folder() / "policy"))
    vec = make_env(env_cfg)["playbyear"][0]
    result = rollout(vec, policy, *make_env_pre_post_processors(env_cfg, policy.config), *own, seeds=[5])
    vec.close()
    env.close()
    expected = result["action"][0].clamp(-1, 1)
    np.testing.assert_array_equal(episode.actions, expected)
    assert not episode.interventions.any()


def test_the_whole_attempt_is_recorded_and_tagged_where_the_expert_acted():
    expert = Scripted(steps=range(4, 9))
    env, actor, _ = scene()
    episode = play(env, actor, seed=5, expert=expert)
    assert np.flatnonzero(episode.interventions).tolist() == list(range(4, 9))
    for step, action in expert.actions.items():
        np.testing.assert_array_equal(episode.actions[step], action)
    observation, _ = env.reset(seed=5)
    for t, action in enumerate(episode.actions):
        np.testing.assert_array_equal(observation["agent_pos"], episode.observations[t]["agent_pos"])
        observation, _, terminated, truncated, _ = env.step(action)
    env.close()
    assert terminated or truncated
    assert len(episode) == t + 1


def test_the_policy_remembers_the_steps_in_which_the_expert_acted():
    """Its action after a correction is that of a policy that saw the corrected steps."""
    env, actor, _ = scene()
    episode = play(env, actor, seed=5, expert=Scripted(steps=range(4, 9)))
    actor.reset(env)
    seen = [actor.act(observation) for observation in episode.observations[:-1]]
    env.close()
    np.testing.assert_allclose(np.clip(seen[9], -1, 1), episode.actions[9], atol=1e-6)


@pytest.mark.parametrize(
    ("verdict", "outcome"), [(Verdict.SUCCESS, "kept"), (Verdict.FAILURE, "failed"), (Verdict.DISCARD, "discarded")]
)
def test_an_expert_can_end_an_attempt(verdict, outcome):
    env, actor, _ = scene()
    episode = play(env, actor, seed=5, expert=Scripted(steps=(2,), verdicts={6: verdict}))
    env.close()
    assert len(episode) == 7
    assert episode.success is (verdict is Verdict.SUCCESS)
    assert Method().outcome(episode) == outcome


# A run


def test_a_run_collects_learns_saves_and_evaluates(finished):
    rounds = metrics(finished, "round")
    evaluations = metrics(finished, "eval")
    attempts = metrics(finished, "attempt")

    assert [line["round"] for line in rounds] == [1, 2, 3]
    assert [line["step"] for line in rounds] == [0, 2, 4]  # the first is warming up
    assert [line["round"] for line in evaluations] == [0, 2, 3]
    assert [line["outcome"] for line in attempts].count("kept") == 3
    for line in rounds[1:]:
        assert line["loss_demonstrations"] > 0
        assert line["loss_interventions"] > 0
        parts = (
            "simulation_s",
            "inference_s",
            "update_s",
            "batch_s",
            "loss_s",
            "episode_saving_s",
            "checkpoint_saving_s",
        )
        assert line["total_s"] == pytest.approx(sum(line[part] for part in parts), rel=0.2)
    assert {path.name for path in (finished / "out/checkpoints").iterdir()} == {"000002", "000004", "last", "best"}
    assert {(finished / "out/checkpoints" / name).resolve().name for name in ("last", "best")} == {"000004"}


def test_the_dataset_is_a_plain_one_of_successes_with_corrections(finished):
    dataset = corrections(finished)
    intervention, success = column(dataset, "intervention").ravel(), column(dataset, "next.success").ravel()

    assert dataset.num_episodes == 3
    shares = [line["intervention_share"] for line in metrics(finished, "attempt") if line["outcome"] == "kept"]
    for row, share in zip(dataset.meta.episodes, shares, strict=True):
        episode = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert success[episode][-1]
        assert 0 < intervention[episode].mean() == pytest.approx(share, abs=1e-3)
    assert seeds(finished) == [line["seed"] for line in metrics(finished, "attempt") if line["outcome"] == "kept"]
    assert dataset[0]["observation.audio.gripper"].shape == (800,)


def check_normalisation_is_kept(tuned):
    """Of actions, low-dimensional observations and sound. Batch norm's averages are the network's, and follow its weights."""
    base = base_folder() / "policy"
    files = sorted(path.name for path in base.glob("policy_*processor*.safetensors"))
    assert files
    for name in files:
        before, after = load_file(base / name), load_file(tuned / name)
        assert all(torch.equal(before[key], after[key]) for key in before)
    before, after = (load_file(path / "model.safetensors") for path in (base, tuned))
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    sound = {f"model.spectrogram.audio_gripper.{name}" for name in ("mean", "variance", "n_batches")}
    assert sound <= set(before)
    assert not sound & changed
    assert any(key.endswith("bn1.running_mean") for key in changed)
    assert any(key.endswith("weight") for key in changed)


def test_normalisation_stays_the_checkpoints_for_sound_too(finished):
    check_normalisation_is_kept(finished / "out/checkpoints/last/pretrained_model")


def test_lerobots_commands_take_the_checkpoint_and_the_dataset(finished, tmp_path, monkeypatch):
    policy = finished / "out/checkpoints/last/pretrained_model"

    def run(function, *args):
        monkeypatch.setattr(sys, "argv", ["lerobot", *map(str, args)])
        function()

    evaluation = ("--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}")
    run(lerobot_eval.eval_main, f"--policy.path={policy}", *ENV, *evaluation)
    assert (tmp_path / "eval/eval_info.json").exists()
    data = ("--dataset.repo_id=tests/corrections", f"--dataset.root={finished / 'corrections'}", "--num_workers=0")
    small = ("--steps=1", "--batch_size=2", "--dataset.video_backend=pyav", "--env_eval_freq=0")
    run(lerobot_train.train, f"--policy.path={policy}", *data, *small, f"--output_dir={tmp_path / 'tuned'}")
    assert (tmp_path / "tuned/checkpoints/000001").is_dir()


def test_the_rate_rises_once_and_falls_in_every_round_and_over_the_run():
    cfg = DaggerConfig(DatasetPlace("a/b"), DatasetPlace("c/d"), learning_rate=1.0, warmup_updates=4)
    cfg.episodes, cfg.warmup_episodes, cfg.updates_per_episode = 7, 3, 10
    rounds = [[cfg.rate(10 * done + number, number, 10) for number in range(10)] for done in range(6)]
    first, second, last = rounds[0], rounds[1], rounds[4]
    assert cfg.total_updates() == 50
    assert first[:3] == [0.25, pytest.approx(0.5 * second[1] / second[0]), pytest.approx(0.75 * second[2] / second[0])]
    assert all(rates[1:] == sorted(rates[1:], reverse=True) and rates[-1] < 0.05 for rates in rounds[1:])
    assert [rates[0] for rates in rounds] == pytest.approx([0.25, 0.82, 0.64, 0.46, 0.28, 0.1])
    assert rounds[5][0] < last[0]
    appended = [cfg.rate(10 * done, 0, 10, n_before=5) for done in range(3)]  # two rounds
    assert appended == pytest.approx([0.25, 0.55, 0.1])
    cfg.anneal = False
    assert cfg.rate(17, 7, 10) == 1


def test_from_recorded_corrections_alone_the_rate_falls_once():
    cfg = DaggerConfig(DatasetPlace("a/b"), DatasetPlace("c/d"), learning_rate=1.0, warmup_updates=0)
    cfg.episodes, cfg.updates, cfg.updates_per_episode = 0, 50, 10
    rates = [cfg.rate(step, step % 10, 10) for step in range(50)]
    assert rates == sorted(rates, reverse=True)
    assert (rates[0], rates[25], rates[-1]) == pytest.approx((1.0, 0.5, 0.001), abs=1e-3)


def test_without_a_rate_the_policy_says_it():
    cfg = DaggerConfig(DatasetPlace("a/b"), DatasetPlace("c/d"), policy=PlaybyearConfig(optimizer_lr=2e-3))
    assert cfg.training().optimizer.lr == cfg.largest_rate == 2e-3
    cfg.learning_rate = 1e-4
    assert cfg.training().optimizer.lr == cfg.largest_rate == 1e-4


# Who is kept


@ExpertConfig.register_subclass("test_verdicts")
@dataclass
class VerdictsConfig(ExpertConfig):
    """Ends attempts after three steps: the seeds named are successes, those that `acts` names with the expert's help."""

    successes: str = ""
    acts: str = ""
    discarded: str = ""

    def make(self, env):
        return Verdicts(self)


class Verdicts(Expert):
    def __init__(self, config):
        self.config = config

    def reset(self, env):
        self.n, self.seed = 0, int(env.unwrapped.np_random_seed)

    def _is(self, name):
        return str(self.seed) in getattr(self.config, name).split("+")

    def wants_control(self, observation, policy_action):
        self.n += 1
        return self.n == 2 and self._is("acts")

    def act(self):
        return np.zeros(4, np.float32)

    def verdict(self):
        if self.n < 3:
            return None
        if self._is("discarded"):
            return Verdict.DISCARD
        return Verdict.SUCCESS if self._is("successes") else Verdict.FAILURE


def test_only_successes_with_an_intervention_are_kept_and_the_others_counted(tmp_path):
    choices = ("--expert.type=test_verdicts", "--expert.successes=11+12+14+15", "--expert.acts=10+12+13+14+15")
    options = ("--expert.discarded=14", "--episode_seed=10", "--episodes=2")
    dagger(tmp_path, *choices, *options)

    assert seeds(tmp_path) == [12, 15]
    counts = {key: state(tmp_path)[key] for key in ("attempts", "kept", "failed", "unneeded", "discarded")}
    assert counts == {"attempts": 6, "kept": 2, "failed": 2, "unneeded": 1, "discarded": 1}
    assert [line["outcome"] for line in metrics(tmp_path, "attempt")] == [
        "failed",
        "unneeded",
        "kept",
        "failed",
        "discarded",
        "kept",
    ]


def test_seeds_are_consecutive_and_none_of_the_evaluations(tmp_path):
    choices = ("--expert.type=test_verdicts", "--expert.successes=8+13", "--expert.acts=8+13")
    dagger(
        tmp_path,
        *choices,
        "--episode_seed=8",
        "--seed=10",
        "--eval.n_episodes=3",
        "--eval.batch_size=3",
        "--episodes=2",
    )
    assert [line["seed"] for line in metrics(tmp_path, "attempt")] == [8, 9, 13]


def test_a_policy_that_needs_no_help_ends_the_run(tmp_path, capfd):
    choices = ("--expert.type=test_verdicts", "--expert.successes=10+11+12+13", "--expert.acts=10")
    out = dagger(tmp_path, *choices, "--episode_seed=10", "--episodes=5", "--max_attempts=3")
    assert "needed no help in 3 attempts in a row" in "".join(capfd.readouterr())
    assert seeds(tmp_path) == [10]
    assert (out / "checkpoints/last/pretrained_model/model.safetensors").is_file()


def test_attempts_of_which_none_can_be_kept_are_told_as_what_they_were(tmp_path, capfd):
    choices = ("--expert.type=test_verdicts", "--expert.successes=10+11", "--expert.acts=12")
    dagger(tmp_path, *choices, "--episode_seed=10", "--episodes=5", "--max_attempts=3")
    printed = "".join(capfd.readouterr())
    assert "None of 3 attempts in a row could be kept: 2 needed no help, 1 failed, and 0 were thrown away." in printed
    assert "No update was made: no attempt was kept.\nGo on:" in printed


def test_an_expert_that_rescues_nothing_is_an_error(tmp_path):
    with pytest.raises(PlaybyearError, match="3 of 3 attempts in a row failed in spite of the expert"):
        dagger(tmp_path, "--expert.type=test_verdicts", "--max_attempts=3")


def test_the_interventions_of_another_run_are_appended_to(finished, tmp_path):
    before = seeds(finished)
    dagger(finished, "--episodes=4", "--env.episode_length=200", f"--output_dir={tmp_path / 'out'}")
    after = seeds(finished)
    assert after[:3] == before
    assert len(after) == 4
    assert after[3] > max(before)


# From recorded corrections alone


def test_without_an_environment_it_learns_from_what_is_there(finished, tmp_path):
    offline = ("--episodes=0", "--updates=5", f"--interventions.root={finished / 'corrections'}")
    out = command(*arguments(tmp_path, *offline, env=()))
    assert [line["step"] for line in metrics(tmp_path, "round")] == [2, 4, 5]
    assert (out / "checkpoints/last").resolve().name == "000005"
    check_normalisation_is_kept(out / "checkpoints/last/pretrained_model")
