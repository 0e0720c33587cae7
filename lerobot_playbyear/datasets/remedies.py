"""The commands that put a dataset right, as messages print them: whole, so that they can be pasted into a shell."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path


def repair_command(root: Path) -> str:
    """Writes a copy of what is whole."""
    return shlex.join(["playbyear-repair", f"--root={root}"])


def convert_command(root: Path) -> str:
    """Brings a dataset of LeRobot's format 2.1 to 3.0, in its place; what was there is kept beside it."""
    options = [f"--repo-id={_name(root)}", f"--root={root}", "--push-to-hub=false"]
    return shlex.join(["python", "-m", "lerobot.scripts.convert_dataset_v21_to_v30", *options])


def recompute_command(root: Path) -> str:
    """Recomputes `meta/stats.json`. Without the new name and place LeRobot would write a copy elsewhere."""
    return _edit(root, *_new(root), "--operation.type=recompute_stats", "--operation.overwrite=true")


def task_command(root: Path, episodes: Sequence[int], task: str) -> str:
    """Gives some episodes a task, in the dataset's place."""
    texts = json.dumps({str(number): task for number in episodes}, ensure_ascii=False)
    return _edit(root, "--operation.type=modify_tasks", f"--operation.episode_tasks={texts}")


def without_feature(root: Path, key: str) -> str:
    """Writes a copy without a feature; where, stands behind the command."""
    target = Path(f"{root}_without_{key.rsplit('.', 1)[-1]}")
    names = f"--operation.feature_names={json.dumps([key], ensure_ascii=False)}"
    return f"{_edit(root, *_new(target), '--operation.type=remove_feature', names)} (it writes {target})"


def without_episodes(root: Path, episodes: Sequence[int]) -> str:
    """Writes a copy without some episodes; where, stands behind the command."""
    target, which = Path(f"{root}_shorter"), f"--operation.episode_indices={list(episodes)}"
    return f"{_edit(root, *_new(target), '--operation.type=delete_episodes', which)} (it writes {target})"


def _edit(root: Path, *options: str) -> str:
    return shlex.join(["lerobot-edit-dataset", f"--repo_id={_name(root)}", f"--root={root}", *options])


def _new(target: Path) -> list[str]:
    return [f"--new_repo_id={_name(target)}", f"--new_root={target}"]


def _name(root: Path) -> str:
    """LeRobot wants a name; what is on the disk has none."""
    return f"local/{root.absolute().name}"
