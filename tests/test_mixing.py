"""`playbyear-train --mix`: several datasets at once, each with its share, and no batch of two kinds."""

import copy
import json
import shutil
import sys

import numpy as np
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, dataset_features, make_dataset
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from safetensors.torch import load_file

from lerobot_playbyear.datasets import EpisodeStore, RunSampler, run_weights
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.mixture import StoreMixture
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training import loop
from lerobot_playbyear.training.config import MixConfig, PlaybyearTrainConfig, SamplingConfig
from lerobot_playbyear.training.loop import frame_weights
from lerobot_playbyear.training.mixing import learned_meta, mixed_weights

pytestmark = pytest.mark.usefixtures("one_thread")

train = parser.wrap()(loop.train)

STATE = "observation.state"
DELTAS = {CAMERA: range(-2, 1), MICROPHONE: range(-20, 1), STATE: [0], "action": range(-3, 1)}
TINY = (
    "--policy.type=playbyear",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.image_size=16",
    "--policy.vision_width=8",
    "--policy.audio_window_s=0.9",
    "--policy.n_memory_steps=3",
    "--policy.n_supervised_steps=4",
    "--policy.hidden_size=64",
    "--num_workers=0",
    "--batch_size=4",
)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """`main`, and `other`, with three times the sample rate, larger pictures and five times the frames."""
    folder = tmp_path_factory.mktemp("data")
    main = make_dataset(folder / "main", (12, 17), image_size=16, repo_id="tests/main")
    features = dataset_features(sample_rate=48000, image_size=24)
    del features["next.reward"]  # nobody learns from it
    other = make_dataset(folder / "other", (70, 75), seed=1, features=features, repo_id="tests/other")
    return main, other


@pytest.fixture(scope="module")
def stores(datasets):
    options = {"device": "cpu", "image_size": 16, "sample_rates": {MICROPHONE: 16000}}
    return [EpisodeStore.from_dataset(dataset, **options) for dataset in datasets]


def options_of(*weights, **options):
    cfg = object.__new__(PlaybyearTrainConfig)
    cfg.policy = PlaybyearConfig(device="cpu", image_size=16, **options)
    cfg.dataset = copy.copy(type("Dataset", (), {"repo_id": "tests/main", "use_imagenet_stats": True}))
    cfg.mix = [MixConfig("tests/other", weight=weight) for weight in weights]
    cfg.rename_map = {}
    return cfg


# Batches


@pytest.mark.parametrize("as_lerobot", [False, True])
def test_a_batch_holds_the_windows_of_each_store_in_the_order_drawn(stores, as_lerobot):
    mixture = StoreMixture(stores)
    n = len(stores[0])
    drawn = [n, 3, n + 144, 28, 0, n + 71, n + 69, 12]
    batch = mixture.windows(torch.tensor(drawn), DELTAS, as_lerobot)

    assert (len(mixture), mixture.n_episodes) == (n + 145, 4)
    assert ("next.reward" in batch, "intervention" in batch) == (False, as_lerobot)
    for position, frame in enumerate(drawn):
        store, own = (stores[0], frame) if frame < n else (stores[1], frame - n)
        expected = store.windows([own], DELTAS, as_lerobot)
        for key, values in batch.items():
            assert (
                values[position] == expected[key][0]
                if key == "task"
                else torch.equal(values[position], expected[key][0])
            )


@pytest.mark.parametrize("drawn", [[], [3, 2], [40, 41]])
def test_a_batch_of_one_store_or_none_has_the_same_keys(stores, drawn):
    batch = StoreMixture(stores).windows(torch.tensor(drawn, dtype=torch.long), DELTAS, True)
    assert batch.keys() == StoreMixture(stores).windows([3, 40], DELTAS, True).keys()
    assert all(len(values) == len(drawn) for values in batch.values())


@pytest.mark.parametrize("frame", [-1, 174])
def test_a_frame_of_no_store_is_refused(stores, frame):
    with pytest.raises(IndexError, match="but there are 174"):
        StoreMixture(stores).windows([0, frame], DELTAS)


def test_what_differs_in_form_is_never_put_into_one_batch(datasets, stores):
    raw = EpisodeStore.from_dataset(datasets[1], device="cpu")
    with pytest.raises(ValueError, match=rf"\['{MICROPHONE}', '{CAMERA}'\] cannot be put together"):
        StoreMixture([stores[0], raw]).windows([0], DELTAS)


# Shares


@pytest.mark.parametrize("weight", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("sampling", [SamplingConfig(), SamplingConfig(start_weight=8, start_s=0.3)])
def test_every_dataset_has_its_share_whatever_its_size_and_its_own_weights(stores, weight, sampling):
    weights = mixed_weights(
        [run_weights(store, 4, frame_weights(store, sampling)) for store in stores], options_of(weight)
    )
    sampler = RunSampler(weights, seed=0)
    drawn = torch.cat([sampler.draw(7) for _ in range(1500)])
    share = (drawn >= len(stores[0])).double().mean()
    assert share == pytest.approx(weight / (1 + weight), abs=0.01)
    alone = [RunSampler(run_weights(store, 4, frame_weights(store, sampling)), seed=0) for store in stores]
    for number, one in enumerate(alone):  # within a dataset all is as it is without the others
        mine = drawn[(drawn >= len(stores[0])) == bool(number)] - number * len(stores[0])
        expected = torch.cat([one.draw(7) for _ in range(1500)])
        counts = [torch.bincount(each, minlength=145).double() / len(each) for each in (mine, expected)]
        assert (counts[0] - counts[1]).abs().max() < 0.02


def test_without_other_datasets_nothing_changes(stores, datasets):
    weights = run_weights(stores[0], 4)
    assert mixed_weights([weights], options_of()) is weights
    assert learned_meta(options_of(), datasets[0].meta) is datasets[0].meta


# What goes together


def test_the_policy_is_made_for_the_first_rate_and_for_the_statistics_of_all(datasets):
    metas = [dataset.meta for dataset in datasets]
    before = copy.deepcopy(metas[0].features)
    meta = learned_meta(options_of(1.0), *metas)

    assert meta.features == metas[0].features == before
    raw = [np.concatenate([np.array(dataset.hf_dataset["action"]) for dataset in datasets])]
    np.testing.assert_allclose(meta.stats["action"]["min"], raw[0].min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(meta.stats["action"]["mean"], raw[0].mean(axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(meta.stats["action"]["std"], raw[0].std(axis=0), rtol=1e-4)
    assert meta.stats[MICROPHONE] is metas[0].stats[MICROPHONE]
    faster = learned_meta(options_of(1.0, sample_rate=48000), *metas)
    assert (faster.features[MICROPHONE]["shape"], faster.features[MICROPHONE]["info"]["sample_rate"]) == (
        (2400,),
        48000,
    )
    assert metas[0].features == before


def changed(change):
    """The features of a dataset that is not like the first."""
    features = dataset_features(image_size=16)
    change(features)
    return features


def names_of(key, names):
    return changed(lambda features: features[key].update(names=names))


@pytest.mark.parametrize(
    ("features", "fps", "message"),
    [
        (dataset_features(fps=10, image_size=16), 10, "10 frames per second, and .* 20"),
        (dataset_features(image_size=16, microphones=()), 20, rf"lacks \['{MICROPHONE}'\].*--policy.use_audio=false"),
        (dataset_features(image_size=16, cameras=()), 20, rf"lacks \['{CAMERA}'\]"),
        (dataset_features(image_size=16, state_size=6), 20, rf"'{STATE}' is float \(6,\) in .*float \(7,\) in"),
        (dataset_features(image_size=16, action_size=5), 20, r"'action' is float \(5,\) in .*float \(4,\) in"),
        (
            names_of("action", ["y", "x", "z", "grip"]),
            20,
            r"numbers of 'action' are \['y'.*\['x'.*have to mean the same",
        ),
        (changed(lambda f: f[STATE].update(dtype="int64")), 20, rf"'{STATE}' is int64 .*convert the column"),
        (changed(lambda f: f[MICROPHONE].update(dtype="float32")), 20, rf"'{MICROPHONE}' is float .*int16"),
        (
            changed(lambda f: f[CAMERA].update(shape=(12, 16, 3))),
            20,
            "3 x 12 x 16 .*3 x 16 x 16.*smaller --policy.image_size",
        ),
        (changed(lambda f: f[CAMERA].update(shape=(16, 16, 1))), 20, "pictures of 1 x 16 x 16"),
        (changed(lambda f: f[CAMERA].update(dtype="float32")), 20, rf"'{CAMERA}' is float .*pictures of"),
        (
            changed(lambda f: f[MICROPHONE].update(info={"sample_rate": 8000})),
            20,
            "at 8000 Hz and 20 frames per second",
        ),
        (changed(lambda f: f[MICROPHONE].update(info={"sample_rate": "fast"})), 20, "sample_rate 'fast'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_datasets_that_do_not_go_together_are_refused(datasets, features, fps, message):
    main = copy.copy(datasets[0].meta)
    main.info = copy.copy(main.info)
    main.info.features = names_of("action", ["x", "y", "z", "grip"])
    other = copy.copy(main)
    other.repo_id, other.info = "tests/strange", copy.copy(main.info)
    other.info.features, other.info.fps = features, fps
    with pytest.raises(ValueError, match=message) as error:
        learned_meta(options_of(1.0), main, other)
    assert "'tests/strange'" in str(error.value)


@pytest.mark.parametrize(
    ("options", "features"),
    [
        ({"use_audio": False}, dataset_features(image_size=16, microphones=())),
        ({"use_vision": False}, dataset_features(image_size=16, cameras=())),
        ({}, dataset_features(image_size=64, sample_rate=8000, cameras=(CAMERA, "observation.images.wrist"))),
        ({}, names_of("action", {"motors": ["x", "y", "z", "grip"]})),
    ],
    ids=["deaf", "blind", "more than is needed", "names in a group"],
)
def test_what_the_policy_does_not_look_at_may_differ(datasets, options, features):
    other = copy.copy(datasets[0].meta)
    other.info = copy.copy(other.info)
    other.info.features = features
    assert learned_meta(options_of(1.0, **options), datasets[0].meta, other).features == datasets[0].meta.features


# Training


def run(function, *options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train", *map(str, options)])
        return function()


def data(datasets, weight=2.0):
    main, other = datasets
    mix = f"--mix=[{{repo_id: tests/other, root: {other.root}, episodes: [0], weight: {weight}}}]"
    return "--dataset.repo_id=tests/main", f"--dataset.root={main.root}", mix


@pytest.fixture(scope="module")
def trained(datasets, tmp_path_factory):
    output = tmp_path_factory.mktemp("run") / "out"
    run(train, *TINY, *data(datasets), "--steps=4", "--save_freq=2", "--log_freq=2", f"--output_dir={output}")
    return output


def weights_of(checkpoint):
    return load_file(checkpoint / "pretrained_model" / "model.safetensors")


def test_a_policy_learns_from_all(trained, datasets):
    folder = trained / "checkpoints" / "last" / "pretrained_model"
    config = json.loads((folder / "config.json").read_text())
    assert config["sample_rate"] == 16000
    assert config["input_features"][MICROPHONE]["shape"] == [800]
    (path,) = folder.glob("*preprocessor*normalizer*.safetensors")
    lowest = load_file(path)["action.min"]
    expected = [LeRobotDatasetMetadata("tests/x", dataset.root).stats["action"]["min"] for dataset in datasets]
    np.testing.assert_allclose(lowest, np.minimum(*expected), rtol=1e-6)
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert all(np.isfinite(line["loss"]) for line in lines)


def test_a_resumed_run_keeps_the_mix_and_ends_where_an_uninterrupted_one_does(trained, tmp_path):
    half = trained / "checkpoints" / "000002" / "pretrained_model" / "train_config.json"
    kept = PlaybyearTrainConfig.from_pretrained(half)
    assert [(other.repo_id, other.episodes, other.weight) for other in kept.mix] == [("tests/other", [0], 2.0)]
    assert PlaybyearTrainConfig.from_pretrained(half, cli_args=["--mix=[]"]).mix == []
    assert TrainPipelineConfig.from_pretrained(half).steps == 4  # lerobot-train's own file does not know it

    run(train, "--resume=true", f"--config_path={half}", f"--output_dir={tmp_path}")

    resumed, expected = (weights_of(folder / "checkpoints" / "last") for folder in (tmp_path, trained))
    assert all(torch.equal(resumed[key], expected[key]) for key in expected)


def test_a_file_of_options_can_name_it(datasets, tmp_path):
    path = tmp_path / "options.json"
    mix = [{"repo_id": "tests/other", "root": str(datasets[1].root)}, {"repo_id": "tests/third", "weight": 0.1}]
    path.write_text(json.dumps({"dataset": {"repo_id": "tests/main"}, "mix": mix}))
    cfg = PlaybyearTrainConfig.from_pretrained(path)
    assert cfg.mix == [MixConfig("tests/other", str(datasets[1].root)), MixConfig("tests/third", weight=0.1)]


def test_a_policy_is_tuned_with_sound_of_another_rate(trained, datasets, tmp_path):
    policy = trained / "checkpoints" / "last" / "pretrained_model"
    main = ("--dataset.repo_id=tests/other", f"--dataset.root={datasets[1].root}")
    options = ("--policy.push_to_hub=false", "--num_workers=0", "--steps=1", f"--output_dir={tmp_path / 'out'}")
    run(train, f"--policy.path={policy}", *main, *options, "--batch_size=2")
    tuned = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/config.json").read_text())
    assert tuned["sample_rate"] == 16000


def test_another_policy_learns_from_several_too(datasets, tmp_path):
    act = ("--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.dim_model=32")
    small = ("--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.chunk_size=5", "--policy.n_action_steps=5")
    scratch = ("--policy.pretrained_backbone_weights=null", "--steps=1", "--batch_size=8", "--num_workers=0")
    alike = (
        datasets[0],
        make_dataset(tmp_path / "alike", (9,), sample_rate=48000, image_size=16, repo_id="tests/other"),
    )
    run(train, *act, *small, *scratch, *data(alike), f"--output_dir={tmp_path / 'out'}")
    assert (tmp_path / "out/checkpoints/000001").is_dir()
    with pytest.raises(InputError, match=rf"'{CAMERA}' is pictures of 3 x 24 x 24 .*3 x 16 x 16.*equally large"):
        run(train, *act, *small, *scratch, *data(datasets), f"--output_dir={tmp_path / 'other'}")


def test_a_dataset_without_statistics_is_refused(datasets):
    metas = [copy.copy(dataset.meta) for dataset in datasets]
    for stats in (
        None,
        {key: value for key, value in metas[1].stats.items() if key != "action"},
        {"action": {"mean": 0}},
    ):
        metas[1].stats = stats
        with pytest.raises(ValueError, match=r"'tests/other' .* has no statistics of .*'action'.*recompute_stats"):
            learned_meta(options_of(1.0), *metas)


@pytest.mark.parametrize(
    ("mix", "message"),
    [
        ("[{repo_id: tests/main, weight: 0}]", "weight of 'tests/main' must be above 0 and finite, got 0"),
        ("[{repo_id: tests/main, weight: .inf}]", "weight of 'tests/main' must be above 0 and finite, got inf"),
        ("[{repo_id: tests/cut, root: CUT}]", "truncated"),
    ],
)
def test_a_bad_mix_is_refused_before_any_work(datasets, tmp_path, mix, message):
    cut = tmp_path / "cut"
    shutil.copytree(datasets[0].root, cut)
    path = next(cut.glob("data/*/*.parquet"))
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(InputError, match=message):
        run(
            train,
            *TINY,
            *data(datasets)[:2],
            f"--mix={mix.replace('CUT', str(cut))}",
            f"--output_dir={tmp_path / 'out'}",
        )
    assert not (tmp_path / "out").exists()


def test_streaming_is_refused_with_what_to_do(datasets, tmp_path):
    with pytest.raises(InputError, match=r"--dataset.streaming does not work in playbyear-train: give --store=disk"):
        run(train, *TINY, *data(datasets)[:2], "--dataset.streaming=true", f"--output_dir={tmp_path / 'out'}")
