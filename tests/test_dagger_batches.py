"""Balanced batches: half of what is learned from ends on a frame whose action an expert chose."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_playbyear.dagger.batches import BalancedBatches, JoinedBatches, frames_learned_from
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training import EpisodeStore
from lerobot_playbyear.training.batches import PolicyWindows

N_DEMONSTRATIONS = 1000
"""Actions of the demonstrations are below it, those of the attempts above: a window tells where it is from."""


def store(lengths, interventions=None, first=0):
    """Episodes whose action is the number of the frame; `interventions` as 0 and 1 per frame."""
    n = sum(lengths)
    columns = {
        "action": first + torch.arange(n, dtype=torch.float32).unsqueeze(1),
        "observation.state": torch.zeros(n, 2),
    }
    if interventions is not None:
        columns["intervention"] = torch.tensor([mark == "x" for mark in interventions])
    ends = np.cumsum(lengths).tolist()
    return EpisodeStore(columns, [0, *ends[:-1]], ends, fps=20)


def windows(n_windows):
    config = PlaybyearConfig(
        use_vision=False,
        use_audio=False,
        n_memory_steps=3,
        n_supervised_steps=n_windows,
        device="cpu",
        push_to_hub=False,
    )
    return PolicyWindows(config, SimpleNamespace(fps=20, features={}))


def supervised(batch):
    """The last frames of all windows that count, (n,)."""
    return batch["action"][..., 0][~batch["action_is_pad"]].int()


ATTEMPTS = "....xxxxxxxxxxxx..........xxx.....x" + "xx............" + "xxxxxxxxxx"


@pytest.mark.parametrize("n_windows", [1, 8])
def test_half_of_every_batchs_windows_end_on_an_intervention_frame(n_windows):
    demonstrations = store([40, 30])
    interventions = store([35, 14, 10], ATTEMPTS, first=N_DEMONSTRATIONS)
    batches = BalancedBatches(windows(n_windows), demonstrations, interventions, batch_size=12)
    marks = np.array(list(ATTEMPTS)) == "x"

    for number in range(30):
        ends = supervised(batches.batch(number)).numpy()
        from_attempts = ends[ends >= N_DEMONSTRATIONS] - N_DEMONSTRATIONS
        assert len(from_attempts) == len(ends) / 2
        assert marks[from_attempts].all()
        shown, corrected = (supervised(half).numpy() for half in batches.halves(number))
        assert len(shown) == len(corrected) > 0
        assert shown.max() < N_DEMONSTRATIONS <= corrected.min()
        assert len(ends) > 6 * n_windows  # most of the windows that are computed are learned from


@pytest.mark.parametrize("n_skipped", [2, 5])
def test_the_beginning_of_every_correction_can_be_left_out(n_skipped):
    interventions = store([35, 14, 10], ATTEMPTS, first=N_DEMONSTRATIONS)
    batches = BalancedBatches(windows(4), store([40]), interventions, 12, n_skipped=n_skipped)
    wanted, length, episode = [], 0, np.repeat([0, 1, 2], [35, 14, 10])
    for frame, mark in enumerate(ATTEMPTS):
        begins_episode = frame == 0 or episode[frame] != episode[frame - 1]
        if mark == "x" and begins_episode:
            length = n_skipped  # nothing came before it: all of it counts
        length = length + 1 if mark == "x" else 0
        if length > n_skipped:
            wanted.append(frame)
    seen = np.concatenate([supervised(batches.batch(number)).numpy() for number in range(150)])
    assert sorted({int(frame) - N_DEMONSTRATIONS for frame in seen if frame >= N_DEMONSTRATIONS}) == wanted


def test_where_nothing_would_remain_all_is_learned_from():
    learned = frames_learned_from(store([9], "..xxx..xx"), 3)
    assert "".join("x" if frame else "." for frame in learned) == "..xxx..xx"


def test_every_intervention_frame_is_learned_from_alike():
    interventions = store([35, 14, 10], ATTEMPTS, first=N_DEMONSTRATIONS)
    batches = BalancedBatches(windows(4), store([40]), interventions, batch_size=12)
    counts = np.zeros(len(ATTEMPTS))
    for number in range(400):
        ends = supervised(batches.batch(number)).numpy()
        np.add.at(counts, ends[ends >= N_DEMONSTRATIONS] - N_DEMONSTRATIONS, 1)
    marks = np.array(list(ATTEMPTS)) == "x"
    assert counts[~marks].sum() == 0
    relative = counts[marks] / counts[marks].mean()
    assert relative.min() > 0.5
    assert relative.max() < 2


def test_what_was_shown_joins_the_demonstrations_frame_by_frame():
    shown = store([30], "x" * 30, first=N_DEMONSTRATIONS)
    batches = JoinedBatches(windows(4), store([40, 20]), shown, batch_size=12)
    ends = np.concatenate([supervised(batches.batch(number)).numpy() for number in range(500)])
    assert len(ends) == 500 * 12 * 4
    counts = np.bincount(np.where(ends < N_DEMONSTRATIONS, ends, ends - N_DEMONSTRATIONS + 60), minlength=90)
    assert 0.5 < counts.min() / counts.mean() < counts.max() / counts.mean() < 1.6  # ends of episodes lie in few runs
    first, second = batches.halves(0)
    assert (supervised(first) < N_DEMONSTRATIONS).all()
    assert (supervised(second) >= N_DEMONSTRATIONS).all()
