"""What the benchmarks compare with is what they say, and their figures are put together rightly."""

from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def benchmarks_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


@pytest.mark.slow
def test_the_published_scheme_gives_our_actions_for_the_same_weights():
    """Encoding ten frames per window again is slower, and not something else."""
    from reference import Reference, make_policy, random_windows

    torch.manual_seed(0)
    sizes = {"image_size": 224, "vision_width": 64, "hidden_size": 1024, "n_supervised_steps": 1}
    policy = make_policy(**sizes, normalize_encodings=False, low_dimensional_gain=1.0).eval()
    reference = Reference().eval()
    reference.load_from(policy.model.state_dict())
    images, sound, state, _ = random_windows(2)
    batch = {
        "observation.images.front": images,
        "observation.audio.gripper": sound.view(2, -1, 800),
        "observation.state": state,
    }
    with torch.no_grad():
        torch.testing.assert_close(
            reference(images, sound, state), policy.act_from(policy.memory_run(batch))[:, 0], rtol=0, atol=1e-4
        )


@pytest.mark.slow
def test_every_command_reads_an_episode_as_the_memory_benchmark_makes_it(tmp_path):
    from memory import COMMANDS, GIB, long_episode

    assert len(long_episode(tmp_path, 2, 4 * GIB, list(COMMANDS))) == len(COMMANDS)
