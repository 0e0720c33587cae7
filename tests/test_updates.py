"""Updates: LeRobot's to the last bit, and faster ones that learn the same."""

import itertools
import shutil
import sys

import pytest
import torch
from lerobot.configs import parser
from lerobot.datasets import LeRobotDataset
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from safetensors.torch import load_file
from support import shared
from support.policy import Waits, move_to_card, on_card, without_cudnn
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from lerobot_playbyear.training import EpisodeStore, RunSampler, run_weights
from lerobot_playbyear.training.batches import PolicyWindows
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.learner import load_training_state, make_learner, prepare_for_gpu
from lerobot_playbyear.training.report import Figures

pytestmark = pytest.mark.usefixtures("one_thread")

TINY = shared.TINY
NOISY = ("--policy.audio_noise_db=6", "--steps=20")
ADDITIONS = (*("auxiliary_onset=0.1", "auxiliary_way=0.1", "audio_envelope_gain=0.3", "audio_room_noise=true"),
           *("memory_displacement_gain=10", "memory_readers=2", "low_dimensional_offset=0.1"))  # fmt: skip
EVERYTHING = tuple(f"--policy.{option}" for option in ADDITIONS)


@pytest.fixture(scope="module")
def dataset(noise):
    return LeRobotDataset("tests/noise", noise)


@pytest.fixture
def make(dataset, monkeypatch, tmp_path):
    """Makes the parts of a training, with the same weights each time."""

    def parts(*options):
        arguments = [*TINY, *NOISY, "--dataset.repo_id=tests/noise", f"--dataset.root={dataset.root}", *options]
        monkeypatch.setattr(sys, "argv", ["train", *arguments])

        @parser.wrap()
        def validated(cfg: PlaybyearTrainConfig):
            cfg.output_dir = tmp_path / "out"
            shutil.rmtree(cfg.output_dir, ignore_errors=True)
            cfg.validate()
            return cfg

        cfg = validated()
        torch.manual_seed(0)
        return cfg, make_learner(cfg, dataset.meta)

    return parts


@pytest.fixture
def batches(dataset):
    """The same batches each time."""

    def of(parts):
        windows = PolicyWindows(parts.policy.config, dataset.meta)
        store = EpisodeStore.from_dataset(dataset, windows.keys, "cpu")
        sampler = RunSampler(run_weights(store, windows.n_windows))
        return (windows.batch(store, sampler.draw(4, number)) for number in itertools.count())

    return of


def learn(parts, batches, n_updates):
    torch.manual_seed(1)
    return [float(parts.update(batch, 1.0)["loss"]) for batch in itertools.islice(batches, n_updates)]


def weights(parts):
    return {key: value.clone() for key, value in parts.policy.state_dict().items()}


def test_an_update_is_lerobots_to_the_last_bit(make, batches):
    _, ours = make()
    losses = learn(ours, batches(ours), 4)
    _, theirs = make()
    tracker = MetricsTracker(4, 38, 3, {key: AverageMeter(key) for key in ("loss", "grad_norm", "lr", "update_s")})
    torch.manual_seed(1)
    for loss, batch in zip(losses, batches(theirs), strict=False):
        update_policy(
            tracker,
            theirs.policy,
            theirs.preprocessor(batch),
            theirs.optimizer,
            1.0,
            theirs.accelerator,
            lr_scheduler=theirs.scheduler,
        )
        assert tracker.loss.val == loss
    expected = weights(theirs)
    for key, value in weights(ours).items():
        assert torch.equal(value, expected[key]), key


@pytest.mark.slow
def test_a_whole_update_never_waits_for_the_card(make, batches, monkeypatch):
    """Preprocessor, forward, clipping, the fused optimizer, the schedule, and the figures of the log.

    The backward pass, torch's own, asks the driver for the card; here gradients are there without it.
    """
    _, parts = make(*EVERYTHING)
    batch = next(batches(parts))
    prepare_for_gpu(parts.policy, parts.optimizer.optimizer)
    with FakeTensorMode(allow_non_fake_inputs=True):
        move_to_card(parts.policy)
        parameters = iter(list(parts.policy.parameters()))
        for group in parts.optimizer.optimizer.param_groups:
            group["params"] = [next(parameters) for _ in group["params"]]
        on_it = {key: on_card(value) if isinstance(value, Tensor) else value for key, value in batch.items()}
        parts.preprocessor.steps = [_moved(step) for step in parts.preprocessor.steps]
        monkeypatch.setattr(parts.accelerator, "backward", lambda loss: _give_gradients(parts.policy))
        store = type("Store", (), {"__len__": lambda _: 38, "n_episodes": 3})()
        figures = Figures(4, store, 0, parts.accelerator)
        with Waits() as waits, without_cudnn():
            for _ in range(2):
                figures.add(parts.update(on_it, 1.0))
        assert waits.lines == []


def _give_gradients(policy):
    for parameter in policy.parameters():
        parameter.grad = torch.empty_like(parameter)


def _moved(step):
    """A step of the preprocessor that takes the card for its device."""
    if hasattr(step, "tensor_device"):
        step.device = "cuda"
        step.tensor_device = torch.device("cuda")
        step.non_blocking = True
    if hasattr(step, "_tensor_stats"):
        step.device = "cuda"
        step._tensor_stats = {k: {n: on_card(v) for n, v in stats.items()} for k, stats in step._tensor_stats.items()}
    return step


@pytest.mark.slow
def test_what_a_gpu_is_given_learns_the_same_and_is_saved_and_resumed_as_before(make, batches, tmp_path):
    _, plain = make()
    expected = learn(plain, batches(plain), 3)
    cfg, parts = make()
    prepare_for_gpu(parts.policy, parts.optimizer.optimizer)
    given = batches(parts)
    assert learn(parts, given, 3) == pytest.approx(expected, rel=1e-4)
    folder = tmp_path / "checkpoint"
    parts.write_checkpoint(folder, cfg)
    plain.write_checkpoint(tmp_path / "plain", cfg)
    for name in ("training_state/optimizer_state.safetensors", "pretrained_model/model.safetensors"):
        ours, theirs = load_file(folder / name), load_file(tmp_path / "plain" / name)
        assert {k: (v.shape, v.dtype) for k, v in ours.items()} == {k: (v.shape, v.dtype) for k, v in theirs.items()}

    further = learn(parts, given, 2)

    cfg, resumed = make()
    resumed.policy.load_state_dict(load_file(folder / "pretrained_model" / "model.safetensors"))
    prepare_for_gpu(resumed.policy, resumed.optimizer.optimizer)
    resumed.step = load_training_state(folder, resumed.optimizer.optimizer, resumed.scheduler)
    again = batches(resumed)
    for _ in range(3):
        next(again)
    assert learn(resumed, again, 2) == pytest.approx(further, rel=1e-4)
    assert all(group["fused"] for group in resumed.optimizer.param_groups)
    _, unfused = make()  # as another machine, or lerobot-train, resumes it
    load_training_state(folder, unfused.optimizer.optimizer, unfused.scheduler)
    assert not any(group["fused"] for group in unfused.optimizer.param_groups)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch compiles for a CPU with g++, which is not here")
def test_a_compiled_policy_learns_the_same(make, batches):
    _, plain = make()
    expected = learn(plain, batches(plain), 3)
    _, parts = make("--compile=true")
    assert learn(parts, batches(parts), 3) == pytest.approx(expected, rel=1e-3)
    assert weights(parts).keys() == weights(plain).keys()
