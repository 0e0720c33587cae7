"""`--save_best`, the checkpoint with the lowest held-out loss, and one policy from several checkpoints of a run."""

import json
import math
import shutil

import pytest
import torch
from dataset_factory import make_dataset
from lerobot.policies import make_pre_post_processors
from safetensors import safe_open
from safetensors.torch import load_file
from test_flat_weights import MODEL, TINY, run, train
from test_policy_contract import make_policy

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.training import loop
from lerobot_playbyear.training.checkpoints import BestCheckpoint, average_checkpoints, last_checkpoints

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, (12, 17, 9), image_size=16)
    return ("--dataset.repo_id=tests/noise", f"--dataset.root={root}", "--seed=3")


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A run of six updates with a checkpoint every two, the second of them the best by decree."""
    output, losses = tmp_path_factory.mktemp("run") / "out", iter((0.3, 0.1, 0.2))
    options = ("--steps=6", "--save_freq=2", "--save_best=true", "--dataset.eval_split=0.3", f"--output_dir={output}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "validation_loss", lambda *_: next(losses))
        run(train, *TINY, *data, *options)
    return output


def test_the_best_of_all_checkpoints_is_linked_and_told(trained):
    checkpoints = trained / "checkpoints"
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000002", "000004", "000006", "best", "last"]
    assert (checkpoints / "best").readlink().as_posix() == "000004"  # relative: the folder may be moved
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    validated = [(line["step"], line["loss"]) for line in lines if line["kind"] == "validation"]
    assert validated == [(2, 0.3), (4, 0.1), (6, 0.2)]
    PlaybyearPolicy.from_pretrained(checkpoints / "best" / "pretrained_model")


def test_measuring_held_out_episodes_changes_nothing_that_is_learned(trained, data, tmp_path):
    """As many batches from the same episodes, held-out loss really computed or not."""
    options = (*TINY, *data, "--steps=2", "--dataset.eval_split=0.3")
    run(train, *options, f"--output_dir={tmp_path / 'without'}")
    run(train, *options, "--eval_steps=1", "--save_best=true", "--save_freq=1", f"--output_dir={tmp_path / 'with'}")
    ours, theirs = (load_file(tmp_path / name / "checkpoints/last" / MODEL) for name in ("without", "with"))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_a_resumed_run_knows_what_was_best_and_forgets_what_it_undoes(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "out", symlinks=True)
    for step, best in ((6, "000004"), (4, "000004"), (2, "000002")):
        known = BestCheckpoint(folder, step)
        assert (folder / "checkpoints/best").readlink().as_posix() == best
        assert (known.step, known.loss) == {"000004": (4, 0.1), "000002": (2, 0.3)}[best]
    known.offer(folder / "checkpoints/000006", 0.3)  # as good: the first stays
    known.offer(folder / "checkpoints/000006", math.nan)
    assert known.step == 2
    shutil.rmtree(folder / "checkpoints/000002")
    assert BestCheckpoint(folder, 2).step is None
    assert BestCheckpoint(tmp_path / "nowhere").loss == math.inf


@pytest.mark.parametrize(
    "options", [(), ("--dataset.eval_split=0.3", "--save_checkpoint=false")], ids=["nothing held out", "no checkpoint"]
)
def test_the_best_of_what_is_not_there_is_refused(options, data, tmp_path):
    with pytest.raises(InputError, match=r"--save_best=true.*--dataset\.eval_split=0\.1.*--save_checkpoint=true"):
        run(train, *TINY, *data, "--steps=2", "--save_best=true", *options, f"--output_dir={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()


def test_an_average_is_a_policy_of_the_mean_of_weights_and_statistics(trained, tmp_path):
    folders = last_checkpoints(trained, 3)
    assert [folder.parent.name for folder in folders] == ["000002", "000004", "000006"]
    made = average_checkpoints(folders, tmp_path / "average")
    weights, parts = load_file(made / "model.safetensors"), [load_file(f / "model.safetensors") for f in folders]
    assert any(name.endswith("running_mean") for name in weights)
    for name, value in weights.items():
        each = [part[name] for part in parts]
        wanted = sum(v.double() for v in each) / 3 if value.is_floating_point() else each[-1]
        torch.testing.assert_close(value, wanted.to(each[-1].dtype), rtol=0, atol=0)
    assert any((weights[name] - value).abs().max() > 1e-4 for name, value in parts[-1].items())
    policy = PlaybyearPolicy.from_pretrained(made, strict=True)
    make_pre_post_processors(policy.config, pretrained_path=str(made))
    with safe_open(made / "model.safetensors", "pt") as file:
        assert file.metadata()["format"] == "pt"
    others = {path.name for path in folders[-1].iterdir()}
    assert {path.name for path in made.iterdir()} == others
    for name in others - {"model.safetensors"}:
        assert (made / name).read_bytes() == (folders[-1] / name).read_bytes()


def test_an_average_of_one_is_that_one_and_odd_ones_are_refused(trained, tmp_path):
    (folder,) = last_checkpoints(trained, 1)
    made = average_checkpoints([folder], tmp_path / "same")
    ours, theirs = (load_file(path / "model.safetensors") for path in (made, folder))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    with pytest.raises(InputError, match="is there already"):
        average_checkpoints([folder], made)
    with pytest.raises(InputError, match="holds 3 checkpoints, wanted the last 4: train with a smaller --save_freq"):
        last_checkpoints(trained, 4)
    make_policy().save_pretrained(tmp_path / "other")
    with pytest.raises(InputError, match="another network"):
        average_checkpoints([folder, tmp_path / "other"], tmp_path / "mixed")
    with pytest.raises(InputError, match="at least one"):
        average_checkpoints([], tmp_path / "nothing")
    assert not (tmp_path / "mixed").exists()
