"""On a GPU all weights of an LSTM lie in one buffer: every checkpoint is written, read and resumed all the same.

The buffer is cuDNN's; here the CPU gets the like of it, so that nobody needs a card to see it work. `test_cuda.py` does
the same on one.
"""

import sys

import pytest
import torch
from dagger_factory import QUICK, command, dagger
from dataset_factory import make_dataset
from lerobot.configs import parser
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from lerobot.scripts import lerobot_train
from safetensors import safe_open
from safetensors.torch import load_file
from test_policy_contract import make_config, make_policy
from test_policy_training import batch_of
from torch import nn

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.training import loop

pytestmark = pytest.mark.usefixtures("one_thread")

train = parser.wrap()(loop.train)

TINY = (
    "--policy.type=playbyear",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.image_size=16",
    "--policy.vision_width=4",
    "--policy.audio_window_s=0.9",
    "--policy.n_memory_steps=2",
    "--policy.n_supervised_steps=2",
    "--policy.hidden_size=32",
    "--num_workers=0",
    "--batch_size=2",
    "--log_freq=1",
)
MODEL = "pretrained_model/model.safetensors"


def flatten(lstm):
    """What cuDNN does as soon as an LSTM is moved to a GPU: every weight becomes a view of one buffer."""
    weights = [weight for weight in lstm._flat_weights if weight is not None]
    buffer = torch.cat([weight.detach().flatten() for weight in weights])
    for weight, part in zip(weights, buffer.split([weight.numel() for weight in weights]), strict=True):
        weight.data = part.view_as(weight)


@pytest.fixture
def one_buffer(monkeypatch):
    monkeypatch.setattr(nn.RNNBase, "flatten_parameters", flatten)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, (12, 17), image_size=16)
    return root


def run(script, *arguments):
    """A training script in this process, as the command line would."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train", *map(str, arguments)])
        script()


def storages(policy):
    return {weight.untyped_storage().data_ptr() for weight in policy.model.memory_head.lstm.parameters()}


def assert_same_weights(file, other):
    ours, theirs = load_file(file), load_file(other)
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def test_a_policy_whose_lstm_lies_in_one_buffer_is_saved_as_any_other(tmp_path, one_buffer):
    policy = make_policy()
    policy.to("cpu")
    assert len(storages(policy)) == 1

    policy.save_pretrained(tmp_path)

    with safe_open(tmp_path / "model.safetensors", "pt") as file:
        assert set(file.keys()) == policy.state_dict().keys()
        for name, value in policy.state_dict().items():
            assert torch.equal(file.get_tensor(name), value)
    size = sum(value.numel() * value.element_size() for value in policy.state_dict().values())
    assert (tmp_path / "model.safetensors").stat().st_size < size + 2**15  # no weight drags the whole buffer along


def test_saving_leaves_the_weights_in_their_buffer(tmp_path, one_buffer):
    policy = make_policy()
    before = {name: value.data_ptr() for name, value in policy.state_dict().items()}

    policy.save_pretrained(tmp_path)

    assert {name: value.data_ptr() for name, value in policy.state_dict().items()} == before


def test_a_checkpoint_is_read_into_a_policy_whose_lstm_lies_in_one_buffer(tmp_path, monkeypatch):
    policy = make_policy()
    policy.save_pretrained(tmp_path)
    monkeypatch.setattr(nn.RNNBase, "flatten_parameters", flatten)

    again = PlaybyearPolicy.from_pretrained(tmp_path)

    assert len(storages(again)) == 1
    for name, value in policy.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)
    with torch.no_grad():
        batch = batch_of(policy)
        torch.testing.assert_close(again.predict_run(batch), policy.predict_run(batch), rtol=0, atol=1e-6)


def test_a_checkpoint_that_does_not_fit_is_refused_whatever_the_storage(tmp_path, one_buffer):
    make_policy(use_audio=False).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="does not fit"):
        PlaybyearPolicy.from_pretrained(tmp_path, config=make_config())
    with pytest.raises(ValueError, match="does not fit"):
        PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(use_audio=False, vision_width=8))


def test_the_optimizer_of_such_a_policy_is_saved_and_goes_on(tmp_path, one_buffer):
    policy = make_policy(n_supervised_steps=2).train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    for _ in range(2):
        policy.forward(batch_of(policy))[0].backward()
        optimizer.step()

    policy.save_pretrained(tmp_path)
    save_optimizer_state(optimizer, tmp_path)
    again = PlaybyearPolicy.from_pretrained(tmp_path).train()
    resumed = load_optimizer_state(again.config.get_optimizer_preset().build(again.get_optim_params()), tmp_path)

    for parameter, its_like in zip(policy.parameters(), again.parameters(), strict=True):
        ours, theirs = optimizer.state[parameter], resumed.state[its_like]
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    gradients = [torch.randn_like(parameter) for parameter in policy.parameters()]
    for each, its_optimizer in ((policy, optimizer), (again, resumed)):
        for parameter, gradient in zip(each.parameters(), gradients, strict=True):
            parameter.grad = gradient.clone()
        its_optimizer.step()
    assert all(torch.equal(a, b) for a, b in zip(policy.parameters(), again.parameters(), strict=True))


@pytest.mark.parametrize(
    "script",
    [train, pytest.param(lerobot_train.train, marks=pytest.mark.slow)],
    ids=["playbyear-train", "lerobot-train"],
)
def test_a_training_saves_its_checkpoints_and_is_resumed(script, root, tmp_path, monkeypatch):
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={root}", "--seed=3")
    run(script, *TINY, *data, "--steps=2", f"--output_dir={tmp_path / 'plain'}")
    monkeypatch.setattr(nn.RNNBase, "flatten_parameters", flatten)

    run(script, *TINY, *data, "--steps=2", "--save_freq=1", f"--output_dir={tmp_path / 'out'}")
    half = tmp_path / "out/checkpoints/000001/pretrained_model/train_config.json"
    run(script, "--resume=true", f"--config_path={half}", f"--output_dir={tmp_path / 'resumed'}")

    plain = tmp_path / "plain/checkpoints/last" / MODEL
    assert_same_weights(tmp_path / "out/checkpoints/last" / MODEL, plain)
    if script is train:  # lerobot-train draws other batches after a resume of so small a dataset
        assert_same_weights(tmp_path / "resumed/checkpoints/000002" / MODEL, plain)
    assert (tmp_path / "resumed/checkpoints/000002" / MODEL).is_file()


@pytest.mark.slow
def test_dagger_saves_its_checkpoints_and_goes_on(tmp_path, one_buffer):
    dagger(tmp_path, *QUICK, "--episodes=1")
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=2")

    assert (tmp_path / "out/checkpoints/last" / MODEL).resolve().parts[-3] == "000004"
