"""Commands that make a copy or an upload, killed at random moments: what is there is whole, and the command goes on."""

import random
import shutil
import time
from pathlib import Path

import pytest
from support.commands import Commands
from support.hub import HubServer
from test_attach_audio import write_sounds

OFTEN = pytest.param(40, id="40", marks=[pytest.mark.slow, pytest.mark.timeout(1800)])


@pytest.fixture(scope="module")
def damaged(noise, tmp_path_factory) -> Path:
    """A dataset whose last table lost its end."""
    root = Path(shutil.copytree(noise, tmp_path_factory.mktemp("damaged") / "dataset"))
    path = max((root / "data").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-40])
    return root


@pytest.fixture(scope="module")
def sounds(tmp_path_factory) -> str:
    """A file of sound for each episode of `silent`."""
    return write_sounds(tmp_path_factory.mktemp("sounds"))


def content(root: Path) -> dict[str, bytes]:
    """What a dataset says and holds; the lock of who looked at it aside."""
    files = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in files.items() if path.name != ".lock"}


def at_a_random_moment(commands: Commands, command: list[str], seconds: float, rng: random.Random) -> bool:
    """Runs a command that takes so long, and kills it unless it ends before. Returns whether it was killed."""
    end = time.monotonic() + rng.uniform(0, seconds)
    return commands.run(*command, kill_when=lambda: time.monotonic() > end).status < 0


@pytest.mark.parametrize("n_kills", [2, OFTEN])
@pytest.mark.parametrize("name", ["repair", "attach-audio", "attach-spectrogram"])
def test_a_copy_is_there_whole_or_not_at_all(name, n_kills, damaged, silent, noise, sounds, commands, tmp_path):
    source = {"repair": damaged, "attach-audio": silent, "attach-spectrogram": noise}[name]
    original, target = content(source), tmp_path / "copy"
    places = [f"--dataset.root={source}", "--dataset.repo_id=tests/noise", "--output.repo_id=tests/copy"]
    options = {
        "repair": [f"--root={source}", f"--output={target}"],
        "attach-audio": [*places, f"--output.root={target}", f"--files={sounds}"],
        "attach-spectrogram": [*places, f"--output.root={target}", "--seconds=0.8"],
    }
    command = [f"playbyear-{name}", *options[name]]
    commands.run(command[0], "--help")  # what all commands are forked from has to begin first
    start = time.monotonic()
    commands.succeed(*command)
    seconds, whole = time.monotonic() - start, content(target)
    shutil.rmtree(target)
    rng, n_killed = random.Random(0), 0
    for _ in range(n_kills):
        n_killed += at_a_random_moment(commands, command, seconds, rng)
        assert not target.exists() or content(target) == whole
        assert content(source) == original
        if target.exists():
            shutil.rmtree(target)
    assert n_killed or n_kills < 10
    commands.succeed(*command)
    assert content(target) == whole


@pytest.mark.parametrize("n_kills", [OFTEN])
def test_an_upload_is_there_whole_or_not_at_all(n_kills, noise, hub, commands):
    """Killed once, after it began: `test_hub.py`."""
    rng = random.Random(0)
    push = ["playbyear-push", f"--dataset.root={noise}"]
    commands.run("playbyear-push", "--help")
    start = time.monotonic()
    commands.succeed(*push, "--dataset.repo_id=tester/0")
    seconds, whole = time.monotonic() - start, names_on(hub, "tester/0")
    for number in range(1, n_kills + 1):
        name = f"tester/{number}"
        at_a_random_moment(commands, [*push, f"--dataset.repo_id={name}"], 1.2 * seconds, rng)
        if ("datasets", name) in hub.repositories:  # it may have been killed before
            assert names_on(hub, name) in (set(), whole)
            assert not hub.dataset(name).tags or names_on(hub, name) == whole
        commands.succeed(*push, f"--dataset.repo_id={name}")
        repository = hub.dataset(name)
        assert names_on(hub, name) == whole
        assert repository.resolve("v3.0") == repository.resolve("main")


def names_on(hub: HubServer, name: str) -> set[str]:
    return {path for path in hub.dataset(name).files() if path != ".gitattributes"}
