"""What corrections show: a search and its hop, or only what comes after the grasp."""

import numpy as np

from experiments.hops import AFTER, OPEN, Shown, holds_a_hop, shown_in
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record


def closing(*pieces):
    return np.concatenate([np.full(n, closes) for closes, n in pieces])


def test_a_hop_ends_a_search_and_is_no_grasp_at_once():
    assert holds_a_hop(closing((False, AFTER), (True, 20)))
    assert holds_a_hop(closing((True, 40), (False, OPEN), (True, 20)))  # it opened, and searched anew
    assert not holds_a_hop(closing((False, AFTER - 1), (True, 20)))
    assert not holds_a_hop(closing((True, 60), (False, 10)))
    assert not holds_a_hop(closing((True, 40), (False, OPEN - 1), (True, 20)))


def test_a_demonstration_holds_one(tmp_path):
    folder = tmp_path / "demos"
    dataset = RecordDatasetConfig("tests/hops", str(folder), num_episodes=1)
    record(RecordConfig(PlaybyearEnvConfig(task="OccludedPickPlace-v1", image_size=16), dataset, num_workers=0))
    shown = shown_in(folder)
    assert shown == Shown("demos", corrections=1, hops=1, closed=0, frames=shown.frames)
    assert shown.frames > 80
