"""Training and acting ask Apple's GPUs for nothing that they have not: no operator, no padding, no 64-bit float.

Without such a machine, every operator is recorded that torch calls on a CPU when the CPU's own short cuts are off.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import yaml
from lerobot.policies import make_pre_post_processors
from mps_operators import COMPOSITES, IN_PLACE_OF_OTHERS, KERNELS
from test_policy_contract import make_config, make_episode, run_ending_at
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from lerobot_playbyear.policy.image_augmentation import Augmentation, sample
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

ZEROS, BILINEAR = 0, 0  # how aten counts paddings and interpolations


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
    return PlaybyearPolicy(make_config(audio_noise_db=0.0, low_dimensional_noise=0.03, n_supervised_steps=3))


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
    policy.eval()
    before, after = processors
    observations = [{k: torch.rand(1, *f.shape) for k, f in policy.config.input_features.items()} for _ in range(3)]
    with recording() as recorder:
        policy.reset()
        for observation in observations:
            after(policy.select_action(before(observation)))
    return recorder


@pytest.mark.parametrize("work", ["training", "acting"])
def test_only_operators_that_apples_gpus_have_are_used(work, request):
    recorder = request.getfixturevalue(work)
    assert len(recorder.operators) > 40
    assert recorder.operators <= KERNELS | COMPOSITES.keys()


@pytest.mark.parametrize("work", ["training", "acting"])
def test_no_64_bit_float_is_made(work, request):
    assert request.getfixturevalue(work).doubles == set()


def test_grids_are_sampled_only_as_apples_gpus_can(training):
    assert training.samplings == {(BILINEAR, ZEROS)}


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


def of_border(images, grid):
    return torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (48, 64), (84, 84), (224, 298)])
def test_repeated_edges_are_those_of_padding_border(height, width):
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(4, 9, height, width, generator=generator)
    theta = torch.randn(4, 2, 3, generator=generator)  # far over every edge
    grid = torch.nn.functional.affine_grid(theta, [4, 1, 48, 48], align_corners=False)
    assert (grid.abs() > 1).any()
    torch.testing.assert_close(sample(images, grid), of_border(images, grid), rtol=0, atol=1e-5)


def test_images_in_bfloat16_are_moved_as_exactly_as_others():
    images = torch.rand(2, 3, 3, 84, 84).to(torch.bfloat16)
    config = make_config(augmentation_brightness=0.0, augmentation_hue=0.0)
    moved = []
    for values in (images, images.float()):
        torch.manual_seed(1)
        moved.append(Augmentation(config)(values, 84))
    assert moved[0].dtype == torch.bfloat16
    torch.testing.assert_close(moved[0].float(), moved[1], rtol=0, atol=2**-7)  # their last bit, and that of colours
