"""Datasets and policies go to the Hub and come back, through the real client and an HTTP server on loopback."""

import json
import shlex
import shutil
from pathlib import Path

import av
import pytest
import yaml
from support.commands import Result
from support.hub import (
    TOKEN,
    File,
    HubServer,
    Repository,
    every_second,
    git_oid,
    nothing_fails,
    one_in,
)
from support.shared import ENV, TINY

from lerobot_playbyear.datasets.files import FolderLockedError
from lerobot_playbyear.datasets.journal import lock_dataset
from lerobot_playbyear.hub.push import HubError, PushOptions, evaluation_of, push_dataset, push_policy

DATASET = "tester/grasp"
POLICY = "tester/hearing"


@pytest.fixture(scope="module")
def recording(commands, hub_server, tmp_path_factory):
    """A recording whose upload at the end failed, and what the command said."""
    root = tmp_path_factory.mktemp("recording") / "grasp"
    hub_server.fault = lambda method, path: "cut"  # there is no Hub
    dataset = (f"--dataset.repo_id={DATASET}", f"--dataset.root={root}", "--dataset.num_episodes=1")
    result = commands.run("playbyear-record", *ENV, *dataset, "--dataset.push_to_hub=true", "--num_workers=0")
    hub_server.fault = nothing_fails
    return root, result


@pytest.fixture(scope="module")
def pushed(commands, recording):
    """The recording's folder, after the command that was named had its Hub."""
    root, result = recording
    commands.succeed(*command_in(result))
    return root


def command_in(result: Result) -> list[str]:
    """The command that a message tells to run."""
    return next(shlex.split(line) for line in result.output.splitlines() if line.startswith("  playbyear-push "))


def content(root: Path) -> dict[str, bytes]:
    """A dataset's files by their names in it."""
    folders = (root / "data", root / "meta", root / "videos")
    return {
        path.relative_to(root).as_posix(): path.read_bytes() for f in folders for path in f.rglob("*") if path.is_file()
    }


def content_on(hub: HubServer, name: str = DATASET) -> dict[str, bytes]:
    return {
        path: file.data
        for path, file in hub.dataset(name).files("v3.0").items()
        if path.startswith(("data/", "meta/", "videos/"))
    }


def test_a_recording_is_safe_without_the_hub_and_says_how_to_push_it_later(recording):
    root, result = recording
    assert result.status == 1
    assert f"The dataset is complete in {root}, but it could not be uploaded: http" in result.output
    assert "cannot be reached" in result.output
    assert "Traceback" not in result.output
    assert command_in(result) == ["playbyear-push", f"--dataset.repo_id={DATASET}", f"--dataset.root={root}"]
    assert json.loads((root / "meta" / "info.json").read_text())["total_episodes"] == 1


def test_the_repository_holds_the_dataset_and_nothing_of_the_recording(pushed, hub):
    assert content_on(hub) == content(pushed)
    repository = hub.dataset(DATASET)
    assert set(repository.files()) - set(content(pushed)) == {"README.md", "preview.mp4"}
    assert repository.resolve("v3.0") == repository.resolve("main")


def test_the_card_says_what_is_in_the_dataset(pushed, hub):
    card = hub.dataset(DATASET).files()["README.md"].data.decode()
    data = yaml.safe_load(card.split("---\n")[1])
    assert {"LeRobot", "audio"} <= set(data["tags"])
    assert data["task_categories"] == ["robotics"]
    assert "| Episodes | 1, " in card
    assert "| Success | 1 of 1 episodes |" in card
    assert "| Frame rate | 20 Hz |" in card
    assert "`observation.images.front`: 16 x 16 x 3, image" in card
    assert "`observation.audio.gripper`: 16,000 Hz, 800 samples a frame, int16" in card
    assert f"{hub.url}/datasets/{DATASET}/resolve/main/preview.mp4" in card
    assert f"playbyear-train --preset=cpu --dataset.repo_id={DATASET} --output_dir=" in card


def test_the_film_beside_the_card_has_pictures_and_sound(pushed, hub, tmp_path):
    (tmp_path / "film.mp4").write_bytes(hub.dataset(DATASET).files()["preview.mp4"].data)
    with av.open(str(tmp_path / "film.mp4")) as film:
        loudest = max(abs(frame.to_ndarray()).max() for frame in film.decode(audio=0))
        film.seek(0)
        pictures = list(film.decode(video=0))
    info = json.loads((pushed / "meta" / "info.json").read_text())
    assert 0.3 < loudest <= 1.1
    assert 10 < len(pictures) <= info["total_frames"]


def test_what_has_arrived_is_not_sent_again(pushed, hub, commands):
    commits = len(hub.dataset(DATASET).commits)
    commands.succeed("playbyear-push", f"--dataset.repo_id={DATASET}", f"--dataset.root={pushed}")
    assert not hub.arrivals
    assert len(hub.dataset(DATASET).commits) == commits


def test_a_file_that_the_dataset_no_longer_has_goes_from_the_hub(pushed, hub, commands):
    stale = File(git_oid(b"old"), b"old", is_large=False)
    hub.dataset(DATASET).files()["data/chunk-000/file-009.parquet"] = stale
    hub.dataset(DATASET).files()["notes.txt"] = stale
    commands.succeed("playbyear-push", f"--dataset.repo_id={DATASET}", f"--dataset.root={pushed}")
    assert content_on(hub) == content(pushed)
    assert "notes.txt" in hub.dataset(DATASET).files()


def test_an_upload_that_was_killed_goes_on(pushed, hub, commands):
    hub.objects.clear()
    push = ("playbyear-push", "--dataset.repo_id=tester/killed", f"--dataset.root={pushed}")
    hub.fault = lambda method, path: "unavailable" if "/commit/" in path else None  # it is not over before the kill
    assert commands.run(*push, kill_when=lambda: len(hub.arrivals) >= 2).status < 0
    assert len(hub.arrivals) >= 2
    assert not hub.dataset("tester/killed").tags
    hub.fault = nothing_fails
    commands.succeed(*push)
    assert content_on(hub, "tester/killed") == content(pushed)
    assert set(hub.arrivals.values()) == {1}


def test_without_a_login_the_message_says_so_at_once(pushed, hub, commands):
    push = ("playbyear-push", "--dataset.repo_id=tester/secret", f"--dataset.root={pushed}")
    result = commands.run(*push, environment={"HF_TOKEN": TOKEN[::-1]})
    assert result.status == 1
    assert "log in with `hf auth login`" in result.output
    assert len(hub.requests) < 4


def test_lerobot_trains_on_a_dataset_from_the_hub(pushed, hub, commands, tmp_path):
    run = (*TINY, "--steps=2", f"--output_dir={tmp_path / 'out'}")
    commands.succeed("lerobot-train", f"--dataset.repo_id={DATASET}", *run)
    assert content(commands.snapshot(DATASET)) == content(pushed)
    assert (tmp_path / "out" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()


@pytest.mark.slow
def test_our_commands_load_a_dataset_and_a_policy_from_the_hub_although_one_request_in_ten_fails(
    pushed, hub, commands, tmp_path
):
    hub.fault = one_in(10, seed=1)
    policy = ("--policy.push_to_hub=true", f"--policy.repo_id={POLICY}")
    run = (*TINY, *policy, "--steps=2", f"--output_dir={tmp_path / 'out'}")
    commands.succeed("playbyear-train", f"--dataset.repo_id={DATASET}", *run)
    hub.fault = nothing_fails
    evaluation = ("--eval.n_episodes=1", "--eval.batch_size=1", "--policy.device=cpu")
    output = f"--output_dir={tmp_path / 'eval'}"
    commands.succeed("lerobot-eval", f"--policy.path={POLICY}", *ENV, *evaluation, output)
    assert (tmp_path / "eval" / "eval_info.json").is_file()
    assert hub.faults()


def test_a_policy_is_safe_without_the_hub_and_says_how_to_push_it_later(pushed, hub, commands, tmp_path):
    hub.fault = lambda method, path: "cut" if method == "POST" else None
    policy = ("--policy.push_to_hub=true", "--policy.repo_id=tester/later", "--save_checkpoint=false")
    run = (*TINY, *policy, "--steps=1", f"--output_dir={tmp_path / 'out'}")
    result = commands.run("playbyear-train", f"--dataset.repo_id={DATASET}", f"--dataset.root={pushed}", *run)
    assert result.status == 1
    message = result.output[result.output.index("The policy is complete in ") :]
    assert "cannot be reached" in message
    assert "Traceback" not in message
    hub.fault = nothing_fails
    film = tmp_path / "film.mp4"
    film.write_bytes(hub.dataset(DATASET).files()["preview.mp4"].data)
    commands.succeed(*command_in(result), f"--preview={film}")
    files = hub.model("tester/later").files()
    assert {"config.json", "model.safetensors", "train_config.json"} <= set(files)
    assert files["preview.mp4"].data == film.read_bytes()
    card = files["README.md"].data.decode()
    assert f"{hub.url}/tester/later/resolve/main/preview.mp4" in card
    assert {"audio", "lerobot", "playbyear", "robotics"} <= set(yaml.safe_load(card.split("---\n")[1])["tags"])
    assert "| Microphones | `observation.audio.gripper`: 16,000 Hz, 800 samples a step |" in card
    assert "lerobot-eval --policy.path=tester/later" in card
    assert DATASET in card
    hub.arrivals.clear()
    refused = commands.run(*command_in(result), "--license=CC BY 4.0")
    assert "the Hub refuses its card, give another license or other tags" in refused.output
    assert not hub.arrivals


def test_a_dataset_goes_up_and_comes_back_although_one_request_in_ten_fails(pushed, hub, commands):
    hub.objects.clear()
    hub.fault = one_in(10, seed=6)
    commands.succeed("playbyear-push", "--dataset.repo_id=tester/rough", f"--dataset.root={pushed}")
    assert content_on(hub, "tester/rough") == content(pushed)
    commands.succeed("playbyear-inspect", "--dataset.repo_id=tester/rough", "--json")
    assert content(commands.snapshot("tester/rough")) == content(pushed)
    assert hub.faults()


@pytest.mark.slow
def test_a_corrected_policy_goes_up_from_dagger(trained, recorded, hub, commands, tmp_path):
    commands.succeed(
        "playbyear-dagger",
        f"--policy.path={trained}",
        "--policy.push_to_hub=true",
        "--policy.repo_id=tester/corrected",
        "--dataset.repo_id=tests/demos",
        f"--dataset.root={recorded}",
        "--interventions.repo_id=tester/corrections",
        f"--interventions.root={tmp_path / 'corrections'}",
        f"--output_dir={tmp_path / 'dagger'}",
        *ENV,
        *("--num_episodes=1", "--updates_per_episode=1", "--warmup_episodes=1", "--batch_size=2", "--eval_every=0"),
    )
    weights = (tmp_path / "dagger" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").read_bytes()
    assert hub.model("tester/corrected").files()["model.safetensors"].data == weights
    assert "## Hearing" in hub.model("tester/corrected").files()["README.md"].data.decode()


def test_a_dataset_on_the_hub_that_claims_too_much_is_refused_before_its_data_comes(pushed, hub, commands):
    files = dict(hub.dataset(DATASET).files("v3.0"))
    info = {**json.loads(files["meta/info.json"].data), "total_episodes": 50_000_000}
    data = json.dumps(info).encode()
    hostile = hub.repositories["datasets", "tester/hostile"] = Repository("datasets", "tester/hostile")
    hostile.commits[hostile.resolve("main")] = {**files, "meta/info.json": File(git_oid(data), data, is_large=False)}
    hostile.tags["v3.0"] = hostile.resolve("main")
    result = commands.run("playbyear-inspect", "--dataset.repo_id=tester/hostile")
    assert result.status == 2
    assert "total_episodes is 50,000,000, but meta/episodes has 1" in result.output
    assert not [path for _, path, _ in hub.requests if "/data/" in path]


@pytest.mark.parametrize("kind", ["lost", "late", "cut"])
def test_a_commit_whose_answer_is_lost_happens_once(pushed, hub, commands, kind):
    hub.repositories.pop(("datasets", "tester/once"), None)
    hub.fault = every_second(kind, "POST", "/commit/")
    commands.succeed("playbyear-push", "--dataset.repo_id=tester/once", f"--dataset.root={pushed}")
    assert content_on(hub, "tester/once") == content(pushed)
    assert hub.dataset("tester/once").messages == ["initial commit", "Upload dataset"]


@pytest.mark.slow
def test_checkpoints_go_up_once_although_answers_are_lost(pushed, hub, commands, tmp_path):
    hub.fault = every_second("lost", "POST", "/commit/|/tag/|/create")
    run = (*TINY, "--policy.push_to_hub=true", "--policy.repo_id=tester/steps", "--steps=2", "--save_freq=1")
    more = ("--save_checkpoint_to_hub=true", f"--output_dir={tmp_path / 'out'}")
    result = commands.succeed(
        "playbyear-train", f"--dataset.repo_id={DATASET}", f"--dataset.root={pushed}", *run, *more
    )
    assert "was not uploaded" not in result.output
    repository = hub.model("tester/steps")
    assert repository.messages == ["initial commit", "checkpoint 000001", "checkpoint 000002", "Upload policy"]
    weights = repository.files("000001")["checkpoints/000001/pretrained_model/model.safetensors"].data
    assert weights == (tmp_path / "out/checkpoints/000001/pretrained_model/model.safetensors").read_bytes()


# What an upload looks at before, and beside, its work


@pytest.fixture
def dataset(noise, tmp_path):
    shutil.copytree(noise, tmp_path / "set")
    return tmp_path / "set"


@pytest.fixture
def film(tmp_path):
    (tmp_path / "film.mp4").touch()
    return tmp_path / "film.mp4"


def test_a_dataset_that_is_being_recorded_to_is_not_uploaded(dataset, here, film):
    lock = lock_dataset(dataset)
    with pytest.raises(FolderLockedError, match="Another process is writing to"):
        push_dataset("tester/set", dataset, PushOptions(preview=film))
    lock.close()
    assert not here.requests
    assert push_dataset("tester/set", dataset, PushOptions(preview=film)) == f"{here.url}/datasets/tester/set"


def test_a_dataset_that_another_tool_changes_meanwhile_gets_no_tag(dataset, here, film):
    def change(method, path):
        if "/commit/" in path:
            (dataset / "meta" / "info.json").write_text((dataset / "meta" / "info.json").read_text() + "\n")

    here.fault = change
    with pytest.raises(HubError, match=r"could not be uploaded: it was changed meanwhile \(meta/info.json\)"):
        push_dataset("tester/changed", dataset, PushOptions(preview=film))
    assert not here.dataset("tester/changed").tags


def test_nothing_private_goes_to_a_repository_that_is_public(dataset, here, film):
    public = here.repositories["datasets", "tester/public"] = Repository("datasets", "tester/public")
    private = PushOptions(private=True, preview=film)
    with pytest.raises(
        HubError, match=r"private=true, but .*/datasets/tester/public is public. Make it private"
    ) as error:
        push_dataset("tester/public", dataset, private)
    assert f"--private=true --preview={film}" in str(error.value)
    assert not here.arrivals
    public.private = True
    push_dataset("tester/public", dataset, private)
    push_dataset("tester/new", dataset, private)
    assert here.dataset("tester/new").private


@pytest.mark.parametrize("config", ['{"type": "play', '{"type": "none_such"}', '{"type": "act", "device": "cpu"}'])
def test_a_damaged_policy_is_told_in_one_line(tmp_path, config):
    (tmp_path / "config.json").write_text(config)
    (tmp_path / "model.safetensors").write_text("cut off")
    with pytest.raises(HubError, match=f"Not pushed. The policy in {tmp_path} cannot be loaded: ") as refused:
        push_policy(tmp_path, "me/policy", PushOptions())
    assert "\n" not in str(refused.value)


def test_no_link_of_a_checkpoint_or_a_run_is_followed(tmp_path):
    secret, run = tmp_path / "secret", tmp_path / "run"
    for folder in (secret, run / "checkpoints/000001/pretrained_model"):
        folder.mkdir(parents=True)
        for name in ("config.json", "model.safetensors"):
            (folder / name).write_text("{}")
    (folder / "notes.json").symlink_to(secret / "config.json")
    with pytest.raises(HubError, match=r"notes\.json' is a link to .*secret/config\.json'"):
        push_policy(folder, "me/policy", PushOptions())
    (run / "checkpoints/last").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    secret.rename(tmp_path / "elsewhere/pretrained_model")
    with pytest.raises(HubError, match=r"its last checkpoint is a link to .*elsewhere"):
        push_policy(run, "me/policy", PushOptions())


# What is known of a policy's success


def test_a_line_of_figures_that_was_cut_off_costs_no_upload(trained, tmp_path):
    run = shutil.copytree(trained.parents[2], tmp_path / "run")
    lines = ['{"kind": "tr', '{"kind": "eval", "step": 2, "pc_success": 90.0}', "7", '{"kind": "eval", "st', "[" * 9999]
    (run / "metrics.jsonl").write_text("\n".join(lines))
    figures = evaluation_of(run / "checkpoints/000002/pretrained_model")
    assert figures == {"kind": "eval", "step": 2, "pc_success": 90.0}


@pytest.mark.parametrize(("step", "success"), [("<b>", 90), (2, "<b>"), (2, None), ([2], 90)])
def test_figures_that_are_no_numbers_are_on_no_card(trained, tmp_path, step, success):
    run = shutil.copytree(trained.parents[2], tmp_path / "run")
    (run / "metrics.jsonl").write_text(json.dumps({"kind": "eval", "step": step, "pc_success": success}))
    (run / "checkpoints/000002/training_state/training_step.json").write_text(json.dumps({"step": step}))
    assert evaluation_of(run / "checkpoints/000002/pretrained_model") is None
