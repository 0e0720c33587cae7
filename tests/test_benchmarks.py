"""What the benchmarks compare with is what they say, and their figures are put together rightly."""

import sys
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def benchmarks_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_the_published_scheme_gives_our_actions_for_the_same_weights():
    """Encoding ten frames per window anew is slower, and not something else."""
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
        torch.testing.assert_close(reference(images, sound, state), policy.predict_run(batch)[:, 0], rtol=0, atol=1e-4)


def test_the_memory_of_a_command_is_limited_and_measured(tmp_path):
    from memory import GIB, measure

    work = "b = bytearray(200 << 20); b[::4096] = b'1' * len(b[::4096]); import time; time.sleep(1)"
    row = measure("work", [sys.executable, "-c", work], GIB, {})
    assert 190 < row.ours <= row.theirs < 400
    for failing, said in (("b = bytearray(2000 << 20)", "MemoryError"), ("raise SystemExit('no file')", "no file")):
        with pytest.raises(RuntimeError, match=rf"(?s)work: status 1: .*{said}"):
            measure("work", [sys.executable, "-c", failing], GIB, {})


@pytest.mark.slow
def test_every_command_reads_an_episode_as_the_memory_benchmark_makes_it(tmp_path):
    from memory import COMMANDS, GIB, long_episode

    assert len(long_episode(tmp_path, 2, 4 * GIB, list(COMMANDS))) == len(COMMANDS)
