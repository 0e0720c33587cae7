"""The store hands out what LeRobot's loader would, faster, and the samplers draw what they promise."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, TASK, dataset_features, make_dataset, random_frame
from lerobot.datasets import LeRobotDataset
from torch.utils.data import default_collate

from lerobot_playbyear.datasets import (
    EpisodeStore,
    RunSampler,
    check_dataset_files,
    run_weights,
)

FPS = 20
LENGTHS = (12, 17, 9)
DELTAS = {CAMERA: range(-4, 1), MICROPHONE: range(-20, 1), "observation.state": range(-20, 1), "action": range(-3, 3)}


@pytest.fixture(scope="module", params=[False, True], ids=["image", "video"])
def root(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, LENGTHS, image_size=16, use_videos=request.param)
    return root


def open_stock(root, episodes=None):
    timestamps = {key: [delta / FPS for delta in deltas] for key, deltas in DELTAS.items()}
    return LeRobotDataset("tests/noise", root, episodes=episodes, delta_timestamps=timestamps, video_backend="pyav")


@pytest.mark.parametrize("episodes", [pytest.param(None, marks=pytest.mark.slow), [0, 2]])
def test_windows_equal_those_of_lerobot(root, episodes):
    stock = open_stock(root, episodes)
    store = EpisodeStore.from_dataset(stock, device="cpu", video_backend="pyav")
    indices = torch.randint(len(stock), (60,), generator=torch.Generator().manual_seed(0)).tolist()

    expected = default_collate([stock[i] for i in indices])
    batch = store.windows(indices, DELTAS, as_lerobot=True)

    assert batch.keys() == expected.keys()
    assert batch.pop("task") == expected.pop("task") == [TASK] * 60
    for key, values in expected.items():
        assert batch[key].dtype == values.dtype, key
        assert torch.equal(batch[key], values), key


def test_compact_windows_hold_the_same_as_integers(root):
    stock = open_stock(root)
    store = EpisodeStore.from_dataset(stock, device="cpu", video_backend="pyav")

    batch = store.windows([0, 14, 37], DELTAS)

    expected = default_collate([stock[i] for i in (0, 14, 37)])
    assert batch[CAMERA].dtype == torch.uint8
    assert batch[MICROPHONE].dtype == torch.int16
    assert torch.equal(batch[CAMERA].float() / 255, expected[CAMERA])
    assert torch.equal(batch[MICROPHONE].long(), expected[MICROPHONE])
    assert torch.equal(batch[f"{CAMERA}_is_pad"], expected[f"{CAMERA}_is_pad"])
    assert "next.reward" not in batch


def test_only_the_keys_asked_for_are_read(root):
    store = EpisodeStore.from_dataset(open_stock(root), keys=["action"], device="cpu")

    assert set(store.keys) == {"action", "index", "episode_index", "frame_index", "task_index", "timestamp"}
    with pytest.raises(ValueError, match=r"holds no 'observation.state'"):
        store.windows([0], {"observation.state": [0]})


def test_appended_episodes_are_as_good_as_read_ones(tmp_path):
    features = dataset_features(image_size=16)
    rng = np.random.default_rng(1)
    episodes = [[{**random_frame(features, rng), "task": task} for _ in range(n)] for n, task in ((5, "a"), (8, "b"))]
    writer = LeRobotDataset.create("tests/noise", FPS, features, root=tmp_path / "all", use_videos=False)
    for frames in episodes:
        for frame in frames:
            writer.add_frame(dict(frame))
        writer.save_episode()
    writer.finalize()
    whole = LeRobotDataset("tests/noise", tmp_path / "all")
    expected = EpisodeStore.from_dataset(whole, device="cpu")
    store = EpisodeStore.from_dataset(LeRobotDataset("tests/noise", tmp_path / "all", episodes=[0]), device="cpu")

    assert store.append_episode(episodes[1]) == 1

    assert (len(store), store.n_episodes, store.starts, store.ends) == (13, 2, [0, 5], [5, 13])
    for i in range(13):
        ours, theirs = (s.windows([i], DELTAS, as_lerobot=True) for s in (store, expected))
        assert ours.pop("task") == theirs.pop("task")
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def test_a_bad_episode_is_refused_and_leaves_the_store_as_it_was(tmp_path):
    store = EpisodeStore.from_dataset(make_dataset(tmp_path / "noise", (4,), image_size=8), device="cpu")
    features = dataset_features(image_size=8)
    good = random_frame(features, np.random.default_rng(0))
    bad_frames = {
        "'action' is missing in frame 0": {key: value for key, value in good.items() if key != "action"},
        "'observation.state' holds NaN": {**good, "observation.state": np.full(7, np.nan, np.float32)},
        r"'action' has shape \(3,\)": {**good, "action": np.zeros(3, np.float32)},
        "'observation.images.front' has dtype": {**good, CAMERA: np.zeros((8, 8, 3), np.float32)},
    }

    for message, frame in bad_frames.items():
        with pytest.raises(ValueError, match=message):
            store.append_episode([frame])
    with pytest.raises(ValueError, match="without frames"):
        store.append_episode([])

    assert len(store) == 4
    assert store.n_episodes == 1


def test_unknown_keys_and_frames_are_named(root):
    dataset = open_stock(root)
    store = EpisodeStore.from_dataset(dataset, keys=["action"], device="cpu")

    with pytest.raises(ValueError, match=r"has no 'observation.audio.table'; it has"):
        EpisodeStore.from_dataset(dataset, keys=["observation.audio.table"])
    with pytest.raises(IndexError, match="the store has 38"):
        store.windows([38], {"action": [0]})


def test_nan_is_refused_with_the_episode_that_holds_it(tmp_path):
    features = dataset_features(image_size=8)
    features[MICROPHONE]["dtype"] = "float32"
    dataset = make_dataset(tmp_path / "noise", (3, 3), features=features)
    path = next((tmp_path / "noise" / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    sound = table.column(MICROPHONE).to_pylist()
    sound[4][17] = float("nan")
    position = table.column_names.index(MICROPHONE)
    pq.write_table(table.set_column(position, table.field(position), pa.array(sound, table.field(position).type)), path)

    dataset = LeRobotDataset("tests/noise", tmp_path / "noise")
    with pytest.raises(ValueError, match=r"'observation.audio.gripper' holds NaN .* in 1 of 6 frames \(episodes \[1\]"):
        EpisodeStore.from_dataset(dataset, device="cpu")


def test_a_truncated_file_is_named(tmp_path):
    make_dataset(tmp_path / "noise", (3,), image_size=8)
    path = next((tmp_path / "noise" / "data").glob("*/*.parquet"))
    path.write_bytes(path.read_bytes()[:-100])

    with pytest.raises(ValueError, match=r"file-000.parquet' is truncated.*playbyear-repair --root="):
        EpisodeStore.load("tests/noise", str(tmp_path / "noise"))


def test_an_empty_dataset_is_refused(tmp_path):
    LeRobotDataset.create("tests/noise", FPS, dataset_features(image_size=8), root=tmp_path / "empty", use_videos=False)

    with pytest.raises(ValueError, match="is empty: no episode was saved"):
        check_dataset_files("tests/noise", tmp_path / "empty")


def make_store(*lengths, sound=None):
    """A store of frames that are nothing but their number, and perhaps a sound."""
    ends = np.cumsum(lengths).tolist()
    columns = {"action": torch.arange(ends[-1]).float()[:, None]}
    if sound is not None:
        columns[MICROPHONE] = sound
    return EpisodeStore(columns, [0, *ends[:-1]], ends, FPS)


def coverage(store, weights, n_windows, n_draws=200, batch_size=64):
    """How often each frame is learned from, relative to the mean."""
    sampler = RunSampler(weights, seed=0)
    counts = torch.zeros(len(store))
    for _ in range(n_draws):
        last = sampler.draw(batch_size)
        for delta in range(n_windows):
            counts.index_add_(0, last - delta, torch.ones(batch_size))
    return counts / counts.mean()


def test_single_windows_are_drawn_evenly():
    store = make_store(30, 50)

    assert torch.allclose(coverage(store, run_weights(store), 1), torch.ones(80), atol=0.3)


@pytest.mark.parametrize("n_windows", [4, 8])
def test_runs_neglect_neither_the_first_nor_the_last_frames(n_windows):
    store = make_store(60, 40)

    covered = coverage(store, run_weights(store, n_windows), n_windows)

    for edge in (covered[:n_windows], covered[60 : 60 + n_windows], covered[60 - n_windows : 60], covered[-n_windows:]):
        assert 0.8 < edge.mean() < 1.2
        assert edge.min() > 0.4


def test_runs_never_reach_out_of_their_episode_unless_it_is_shorter():
    weights = run_weights(make_store(10, 3), 4)

    assert weights[:3].eq(0).all()
    assert weights[3:10].gt(0).all()
    assert weights[10:].tolist() == [0, 0, 3]
    assert weights.sum() == 13


def test_the_last_frames_of_episodes_are_left_out_and_the_others_learned_from_evenly():
    store = make_store(60, 3, 40)

    weights = run_weights(store, 4, n_dropped=7)
    covered = coverage(store, weights, 4)

    assert weights[53:63].eq(0).all()
    assert weights[96:].eq(0).all()
    assert covered[53:63].eq(0).all()
    assert torch.equal(weights[:53], run_weights(make_store(53), 4))


def test_frames_with_more_weight_are_drawn_more_often():
    store = make_store(100, 100)
    mask = torch.arange(200) % 100 < 10

    covered = coverage(store, run_weights(store, 1, 1 + 4 * mask), 1)

    assert covered[mask].mean() / covered[~mask].mean() == pytest.approx(5, rel=0.1)


def test_a_batch_comes_from_as_many_episodes_as_possible():
    store = make_store(*[20] * 8)

    episodes = RunSampler(run_weights(store)).draw(16) // 20

    assert len(episodes.unique()) == 8


def test_a_sampler_continues_where_it_was_saved():
    weights = run_weights(make_store(50, 70), 4)
    sampler = RunSampler(weights, seed=3)
    sampler.draw(8)
    state = sampler.state_dict()
    expected = [sampler.draw(8) for _ in range(3)]

    resumed = RunSampler(weights, seed=99)
    resumed.load_state_dict(state)

    assert all(torch.equal(resumed.draw(8), batch) for batch in expected)
    assert not torch.equal(expected[0], expected[1])


@pytest.mark.parametrize("weights", [torch.zeros(3), torch.tensor([1.0, -1.0]), torch.tensor([1.0, float("nan")])])
def test_impossible_weights_are_refused(weights):
    with pytest.raises(ValueError, match="not all of them 0"):
        RunSampler(weights)
