"""`--policy.dtype`: what training computes in, on every device, in every trainer, and in files from before it was there."""

import json
import sys

import pytest
import torch
from accelerate.state import AcceleratorState
from dataset_factory import make_dataset
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.scripts import lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file
from test_policy_contract import make_config
from torch import nn

from lerobot_playbyear.policy.optimization import training_dtype
from lerobot_playbyear.training import loop
from lerobot_playbyear.training.processes import make_accelerator

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
    "--steps=1",
)


@pytest.fixture(autouse=True)
def precision_of_its_own():
    """Accelerate keeps the first precision of a process, which is right for a command and wrong for many tests."""
    AcceleratorState._reset_state(True)
    yield
    AcceleratorState._reset_state(True)


def card(monkeypatch, has_bfloat16, emulates=True):
    """A machine with an NVIDIA GPU, as far as it is asked what it computes in."""

    def is_bf16_supported(including_emulation=True):
        return has_bfloat16 or (including_emulation and emulates)

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", is_bf16_supported)


@pytest.mark.parametrize(
    ("asked", "use_amp", "expected"),
    [
        (None, True, "bfloat16"),
        (None, False, None),
        ("auto", False, "bfloat16"),
        ("float16", False, "float16"),
        ("float32", True, "float32"),
    ],
)
def test_a_card_with_bfloat16_trains_in_it_without_loss_scaling(monkeypatch, asked, use_amp, expected):
    card(monkeypatch, has_bfloat16=True)
    assert training_dtype(asked, use_amp, "cuda:0") == expected


@pytest.mark.parametrize(
    ("asked", "use_amp", "expected"),
    [(None, True, "float16"), ("auto", False, "float16"), ("bfloat16", False, "bfloat16"), (None, False, None)],
)
def test_an_older_card_trains_in_float16_unless_told_otherwise(monkeypatch, asked, use_amp, expected):
    card(monkeypatch, has_bfloat16=False)
    assert training_dtype(asked, use_amp, "cuda") == expected


@pytest.mark.parametrize(
    ("asked", "use_amp", "capable", "expected"),
    [
        (None, True, False, "bfloat16"),  # as PyTorch's autocast has it
        (None, True, True, "bfloat16"),
        (None, False, True, None),
        ("auto", False, True, "bfloat16"),
        ("auto", False, False, "float32"),
        ("bfloat16", False, False, "bfloat16"),
        ("float32", True, True, "float32"),
    ],
)
def test_a_cpu_trains_in_bfloat16_where_that_is_asked_for(monkeypatch, asked, use_amp, capable, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": capable}, raising=False)
    assert training_dtype(asked, use_amp, "cpu") == expected


@pytest.mark.parametrize(("device", "asked"), [("cpu", "float16"), ("mps", "float16"), ("mps", "bfloat16")])
def test_a_format_that_a_device_lacks_becomes_float32_with_a_word(caplog, device, asked):
    assert training_dtype(asked, False, device) == "float32"
    assert f"'{device}' cannot train in {asked}" in caplog.text


def test_apples_gpus_train_in_float32():
    assert training_dtype("auto", False, "mps") == "float32"
    assert training_dtype(None, False, "mps") is None


def test_an_unknown_format_is_refused():
    with pytest.raises(ValueError, match=r"--policy.dtype must be one of auto, float32, bfloat16, float16, got 'half'"):
        make_config(dtype="half")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, "no"),
        ({"use_amp": True}, "bf16"),
        ({"dtype": "bfloat16"}, "bf16"),
        ({"dtype": "float32", "use_amp": True}, "no"),
    ],
)
def test_the_trainers_of_this_package_take_the_format(options, expected):
    assert make_accelerator(make_config(**options)).mixed_precision == expected


def test_a_file_keeps_what_was_asked_for_and_not_what_one_machine_made_of_it(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    for options in ({"use_amp": True}, {"dtype": "auto"}, {"dtype": "float16"}):
        make_config(**options).save_pretrained(tmp_path)
        saved = json.loads((tmp_path / "config.json").read_text())
        assert (saved["type"], saved["dtype"]) == ("playbyear", options.get("dtype"))

    make_config(dtype="auto").save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).dtype == "bfloat16"
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    assert PreTrainedConfig.from_pretrained(tmp_path).dtype == "float32"


def test_use_amp_still_switches_a_checkpoint_that_was_trained_with_it(tmp_path):
    make_config(use_amp=True).save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).dtype == "bfloat16"
    assert PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--use_amp=false"]).dtype is None


def test_a_configuration_from_before_is_read(tmp_path):
    make_config(use_amp=True).save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    saved = json.loads(path.read_text())
    del saved["dtype"]
    path.write_text(json.dumps(saved))
    assert PreTrainedConfig.from_pretrained(tmp_path).dtype == "bfloat16"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    register_third_party_plugins()
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, (12, 17), image_size=16)
    return root


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--policy.dtype=bfloat16",), torch.bfloat16),
        (("--policy.use_amp=true",), torch.bfloat16),
        (("--policy.use_amp=true", "--policy.dtype=float32"), torch.float32),
    ],
    ids=["dtype", "use_amp", "both"],
)
@pytest.mark.parametrize("script", [train, lerobot_train.train], ids=["playbyear-train", "lerobot-train"])
def test_both_trainers_compute_in_it_and_keep_their_weights_in_float32(
    script, options, expected, root, tmp_path, monkeypatch
):
    computed = set()

    def note(module, inputs, output):
        if isinstance(module, nn.Linear):
            computed.add(output.dtype)

    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={root}", f"--output_dir={tmp_path / 'out'}")
    monkeypatch.setattr(sys, "argv", ["train", *TINY, *data, *options])
    hook = nn.modules.module.register_module_forward_hook(note)
    script()
    hook.remove()

    assert computed == {expected}
    weights = load_file(tmp_path / "out/checkpoints/last/pretrained_model/model.safetensors").values()
    assert all(value.dtype in (torch.float32, torch.int64) for value in weights)
