"""Training and acting on every device, as far as it shows without one: number formats, graphics cards, Apple's GPUs.

What needs a GPU is skipped where there is none.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from accelerate.state import AcceleratorState
from dagger_factory import QUICK, command, dagger
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_train
from mps_operators import COMPOSITES, IN_PLACE_OF_OTHERS, KERNELS
from safetensors.torch import load_file
from support.policy import (
    Waits,
    make_config,
    make_episode,
    move_to_card,
    run_ending_at,
    without_cudnn,
)
from support.shared import TINY, run_in_process
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from lerobot_playbyear.policy.image_augmentation import sample
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy, RecentFrames
from lerobot_playbyear.policy.optimization import training_dtype
from lerobot_playbyear.scripts.commands import train

pytestmark = pytest.mark.usefixtures("one_thread")

both_trainers = pytest.mark.parametrize(
    "script", [train, lerobot_train.train], ids=["playbyear-train", "lerobot-train"]
)

USUAL = {"audio_noise_db": 0.0, "low_dimensional_noise": 0.03, "n_supervised_steps": 3}
NOISY = (*TINY, "--policy.audio_noise_db=0", "--log_freq=1", "--seed=3")
EVERYTHING = USUAL | {
    **{"auxiliary_onset": 0.1, "auxiliary_way": 0.1, "audio_envelope_gain": 0.3, "audio_room_noise": True},
    **{"memory_displacement_gain": 10.0, "memory_readers": 2, "low_dimensional_offset": 0.1},
}
MODEL = "pretrained_model/model.safetensors"
ZEROS, BILINEAR = 0, 0  # how aten counts paddings and interpolations


@pytest.fixture(autouse=True)
def precision_of_its_own():
    """Accelerate keeps the first precision of a process, which is right for a command and wrong for many tests."""
    AcceleratorState._reset_state(True)
    yield
    AcceleratorState._reset_state(True)


# Number formats


@pytest.mark.parametrize(
    ("device", "asked", "use_amp", "has_bfloat16", "expected"),
    [
        ("cuda:0", None, True, True, "bfloat16"),
        ("cuda:0", None, False, True, None),
        ("cuda:0", "auto", False, False, "float16"),
        ("cuda:0", "float32", True, True, "float32"),
        ("cpu", None, True, False, "bfloat16"),  # as PyTorch's autocast has it
        ("cpu", "auto", False, True, "bfloat16"),
        ("cpu", "auto", False, False, "float32"),
        ("mps", "auto", False, True, "float32"),
        ("cpu", "float16", False, True, "float32"),  # with a word
        ("mps", "bfloat16", False, True, "float32"),
    ],
)
def test_the_number_format_is_what_the_device_can_and_what_was_asked_for(
    monkeypatch, caplog, device, asked, use_amp, has_bfloat16, expected
):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: has_bfloat16)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": has_bfloat16}, raising=False)
    assert training_dtype(asked, use_amp, device) == expected
    assert (f"'{device}' cannot train in {asked}" in caplog.text) is (asked in ("float16", "bfloat16"))


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


@both_trainers
def test_both_trainers_compute_in_it_and_keep_their_weights_in_float32(script, noise, tmp_path):
    computed = set()

    def note(module, inputs, output):
        if isinstance(module, nn.Linear):
            computed.add(output.dtype)

    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={noise}", f"--output_dir={tmp_path / 'out'}")
    hook = nn.modules.module.register_module_forward_hook(note)
    run_in_process(script, *NOISY, *data, "--policy.device=cpu", "--policy.use_amp=true", "--steps=1")
    hook.remove()
    assert computed == {torch.bfloat16}
    weights = load_file(tmp_path / "out/checkpoints/last" / MODEL).values()
    assert all(value.dtype in (torch.float32, torch.int64) for value in weights)


# A graphics card that is not there


@pytest.mark.parametrize("options", [USUAL, EVERYTHING], ids=["usual", "everything"])
@pytest.mark.slow
def test_a_training_step_traces_as_one_graph_without_a_break(options):
    """Whatever compiles or replays it meets nothing that needs Python in between."""
    policy = PlaybyearPolicy(make_config(**options)).train()
    batch = run_ending_at(make_episode(1, policy.config), 5, policy.config)
    with torch._dynamo.config.patch(allow_rnn=True):  # torch by itself leaves every LSTM out
        explained = torch._dynamo.explain(lambda batch: policy.forward(batch)[0])(batch)
    assert explained.break_reasons == []
    assert (explained.graph_count, explained.graph_break_count) == (1, 0)


def test_acting_stays_on_the_card_and_the_host_waits_once_per_microphone():
    """For whether its samples are between -1 and 1; the action is waited for anyway. Fake weights cannot be folded."""
    policy = PlaybyearPolicy(make_config(**USUAL)).eval()
    with FakeTensorMode():
        move_to_card(policy)
        recent = RecentFrames(policy.config)
        features = policy.config.input_features.items()
        with Waits() as waits, without_cudnn():
            for _ in range(3):
                frame = {key: torch.rand(1, *feature.shape, device="cuda") for key, feature in features}
                encoding = policy.model.encode(recent.add(frame, policy.model.prepare_images), 1)
                actions = policy.model.memory_head(encoding.unsqueeze(1).repeat(1, policy.config.memory_steps, 1))
        assert actions.device.type == "cuda"
        assert len(waits.lines) == 3
        assert all("peak" in line for line in waits.lines)


# On a GPU all weights of an LSTM lie in one buffer of cuDNN's; here the CPU gets the like of it


def flatten(lstm):
    """What cuDNN does as soon as an LSTM is moved to a GPU: every weight becomes a view of one buffer."""
    weights = [weight for weight in lstm._flat_weights if weight is not None]
    buffer = torch.cat([weight.detach().flatten() for weight in weights])
    for weight, part in zip(weights, buffer.split([weight.numel() for weight in weights]), strict=True):
        weight.data = part.view_as(weight)


def test_a_training_saves_its_checkpoints_and_is_resumed(noise, tmp_path, monkeypatch):
    data = ("--policy.device=cpu", "--dataset.repo_id=tests/noise", f"--dataset.root={noise}")
    run_in_process(train, *NOISY, *data, "--steps=2", f"--output_dir={tmp_path / 'plain'}")
    monkeypatch.setattr(nn.RNNBase, "flatten_parameters", flatten)
    run_in_process(train, *NOISY, *data, "--steps=2", "--save_freq=1", f"--output_dir={tmp_path / 'out'}")
    half = tmp_path / "out/checkpoints/000001/pretrained_model/train_config.json"
    run_in_process(train, "--resume=true", f"--config_path={half}", f"--output_dir={tmp_path / 'resumed'}")

    plain = load_file(tmp_path / "plain/checkpoints/last" / MODEL)
    for folder in ("out", "resumed"):
        weights = load_file(tmp_path / folder / "checkpoints/000002" / MODEL)
        assert all(torch.equal(weights[key], value) for key, value in plain.items())


# A card that is there


AVAILABLE = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}
on_devices = pytest.mark.parametrize(
    "device",
    [
        pytest.param(name, marks=pytest.mark.skipif(not is_available(), reason=f"this machine has no {name}"))
        for name, is_available in AVAILABLE.items()
    ],
)


def actions_of(checkpoint: Path, device: str) -> torch.Tensor:
    """What the policy of a checkpoint does on a device."""
    folder = checkpoint / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=[f"--device={device}"])
    policy = PlaybyearPolicy.from_pretrained(folder, config=config)
    overrides = {"device_processor": {"device": device}}
    processors = make_pre_post_processors(config, str(folder), preprocessor_overrides=overrides)
    return act(policy, *processors, noise_frames(config, 4))


def noise_frames(config: Any, n: int) -> list[dict[str, torch.Tensor]]:
    """An episode of noise."""
    generator = torch.Generator().manual_seed(0)
    features = config.input_features.items()
    return [{key: torch.rand(1, *f.shape, generator=generator) for key, f in features} for _ in range(n)]


def act(policy: PlaybyearPolicy, before: Any, after: Any, frames: list[dict[str, torch.Tensor]]) -> torch.Tensor:
    """What a policy does in an episode, (n_frames, n_actions)."""
    policy.reset()
    return torch.cat([after(policy.select_action(before(frame))) for frame in frames])


@on_devices
@pytest.mark.parametrize("dtype", ["float32", "auto", "float16"])
@both_trainers
def test_a_training_saves_resumes_and_acts(device, script, dtype, noise, tmp_path):
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={noise}", f"--policy.dtype={dtype}")
    saved = ("--steps=4", "--save_freq=2", f"--output_dir={tmp_path}/out")
    run_in_process(script, *NOISY, *data, f"--policy.device={device}", *saved)
    checkpoints = tmp_path / "out/checkpoints"
    half = checkpoints / "000002"
    from_there = f"--config_path={half / 'pretrained_model/train_config.json'}"
    run_in_process(script, "--resume=true", from_there, f"--output_dir={tmp_path}/on")

    folders = (checkpoints / "last", tmp_path / "on/checkpoints/000004", half)
    last, resumed, before = (load_file(folder / MODEL) for folder in folders)
    assert all(value.isfinite().all() for value in (*last.values(), *resumed.values()))
    assert any(not torch.equal(value, before[key]) for key, value in last.items())  # it goes on learning
    if script is train and dtype == "float32":  # which draws the same batches again; kernels on a GPU add in any order
        for key, value in last.items():
            torch.testing.assert_close(resumed[key], value, rtol=1e-2, atol=1e-3)
    torch.testing.assert_close(actions_of(half, device), actions_of(half, "cpu"), rtol=0, atol=1e-2)


@on_devices
def test_hg_dagger_saves_and_goes_on(device, tmp_path):
    dagger(tmp_path, *QUICK, "--num_episodes=1", f"--policy.device={device}")
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=2")

    last = load_file(tmp_path / "out/checkpoints/last" / MODEL)
    assert all(value.isfinite().all() for value in last.values())
    config = PreTrainedConfig.from_pretrained(tmp_path / "out/checkpoints/last/pretrained_model")
    assert torch.device(config.device).type == device


# Apple's GPUs: no operator, no padding and no 64-bit float that they have not; every operator is recorded on a CPU


class Recorder(TorchDispatchMode):
    """Notes the name of every aten operator, what grids were sampled how, and which results are 64-bit floats."""

    def __init__(self):
        super().__init__()
        self.operators, self.samplings, self.doubles = set(), set(), set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        results = function(*args, **(kwargs or {}))
        if function.namespace == "aten":
            name = str(function).removeprefix("aten.").removesuffix(".default")
            self.operators.add(name)
            if name == "grid_sampler_2d":
                self.samplings.add(tuple(args[2:4]))
            for result in results if isinstance(results, tuple | list) else [results]:
                if isinstance(result, Tensor) and result.dtype in (torch.float64, torch.complex128):
                    self.doubles.add(name)
        return results


@contextmanager
def recording() -> Iterator[Recorder]:
    # oneDNN's convolutions and LSTM are the CPU's alone; without them the policy takes the way of all other devices.
    with torch.backends.mkldnn.flags(enabled=False), Recorder() as recorder:
        yield recorder


@pytest.fixture(scope="module")
def policy():
    """With everything switched on, and with images that are shrunk."""
    return PlaybyearPolicy(make_config(**USUAL))


@pytest.fixture(scope="module")
def processors(policy):
    features = {**policy.config.input_features, **policy.config.output_features}
    values = {"mean": 0.0, "std": 1.0, "min": -1.0, "max": 1.0}
    stats = {key: {name: torch.full(f.shape, v) for name, v in values.items()} for key, f in features.items()}
    return make_pre_post_processors(policy.config, dataset_stats=stats)


@pytest.fixture(scope="module")
def training(policy, processors):
    """What an update does: an item that begins before its episode, whole numbers as sound, two steps of the optimizer."""
    batch = run_ending_at(make_episode(1, policy.config), 5, policy.config)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    with recording() as recorder:
        for _ in range(2):
            loss, _ = policy.forward(processors[0](dict(batch)))
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
            optimizer.zero_grad()
    return recorder


@pytest.fixture(scope="module")
def acting(policy, processors, training):
    """What a rollout does: floats as sound, three steps of a new episode."""
    frames = noise_frames(policy.eval().config, 3)
    with recording() as recorder:
        act(policy, *processors, frames)
    return recorder


@pytest.mark.parametrize("work", ["training", "acting"])
def test_only_operators_that_apples_gpus_have_are_used(work, request):
    recorder = request.getfixturevalue(work)
    assert len(recorder.operators) > 40
    assert recorder.operators <= KERNELS | COMPOSITES.keys()
    assert recorder.doubles == set()
    assert recorder.samplings == ({(BILINEAR, ZEROS)} if work == "training" else set())


@pytest.fixture(scope="module")
def table():
    """The kernels that the installed torch was built of: devices by operator."""
    package = find_spec("torchgen")
    path = package and Path(str(package.origin)).parent / "packaged/ATen/native/native_functions.yaml"
    if not path or not path.is_file():
        pytest.skip("this torch comes without its table of kernels")
    functions = yaml.load(path.read_text(), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return {function["func"].split("(")[0]: function for function in functions}


def devices(table, operator):
    function = table[operator]
    if "structured_delegate" in function:
        return devices(table, function["structured_delegate"])
    return {device.strip() for several in function.get("dispatch", {}) for device in several.split(",")}


def test_the_list_agrees_with_torchs_own_table(table):
    inner = {operator for operators in COMPOSITES.values() for operator in operators}
    lacking = sorted(name for name in KERNELS | inner | IN_PLACE_OF_OTHERS if "MPS" not in devices(table, name))
    assert lacking == []
    others = {name for name in COMPOSITES if not any(d.startswith("Composite") for d in devices(table, name))}
    assert others == set()


@pytest.mark.parametrize(("height", "width"), [(16, 16), (224, 298)])
def test_repeated_edges_are_those_of_padding_border(height, width):
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(4, 9, height, width, generator=generator)
    theta = torch.randn(4, 2, 3, generator=generator)  # far over every edge
    grid = torch.nn.functional.affine_grid(theta, [4, 1, 48, 48], align_corners=False)
    assert (grid.abs() > 1).any()
    expected = torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
    torch.testing.assert_close(sample(images, grid), expected, rtol=0, atol=1e-5)
