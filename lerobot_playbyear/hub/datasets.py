"""Uploads a dataset: LeRobot's files, its card with a film beside it, and the tag that LeRobot looks for."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from huggingface_hub import DatasetCard, HfApi

from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, FolderLockedError, entries_below
from lerobot_playbyear.datasets.info import OutsideError, check_links
from lerobot_playbyear.datasets.journal import JournalError, lock_dataset
from lerobot_playbyear.hub.dataset_card import card_tags, describe_dataset
from lerobot_playbyear.hub.preview import film_preview
from lerobot_playbyear.hub.pushing import HubError, PushOptions, check_name, push_patiently
from lerobot_playbyear.hub.repository import HubRepository, check_card
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError

CARD = "README.md"
FILM = "preview.mp4"

_CONTENT = ("data/", "meta/", "videos/")
_LEFT_OUT = ("images", CARD, FILM, ".gitattributes", ".git", ".cache")  # scratch; what is made anew; what is the Hub's

logger = logging.getLogger(__name__)


def push_dataset(repo_id: str, root: str | Path | None = None, options: PushOptions | None = None) -> str:
    """Makes the Hub's repository hold exactly what is in a dataset's folder; its earlier content stays in its history.

    Whoever loads the dataset meanwhile gets the earlier version, until the tag of LeRobot's format moves at the end.

    Args:
        repo_id: Its name on the Hub, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
        options: Whether it is private, and what its card says besides. None: the usual.

    Returns:
        Its address on the Hub.

    Raises:
        HubError: There is no whole dataset in the folder, somebody writes to it, or it could not be uploaded.
    """
    folder, options = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id, options or PushOptions()
    check_name("dataset.repo_id", repo_id, needs_user=True)
    options.check()
    with _locked(folder), TemporaryDirectory() as scratch:
        try:
            source = DatasetSource.open(repo_id, folder)
            check_links(folder)
            files = _files(folder)
            check = partial(_check_unchanged, folder, _stamps(files))
        except (InspectionError, OutsideError, OSError) as error:
            raise HubError(f"Not pushed. {error}") from error
        card = _make_card(source, repo_id, Path(scratch), options)
        push = partial(_push, repo_id, files, card, options.private, check)
        later = [f"--dataset.repo_id={repo_id}", *([f"--dataset.root={root}"] if root is not None else [])]
        return push_patiently(push, f"The dataset is complete in {folder}", later, options)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keeps recordings away from a dataset; where no lock can be made, only `_check_unchanged` notices them."""
    try:
        lock = lock_dataset(folder) if folder.is_dir() else None
    except FolderLockedError as error:
        raise HubError(
            f"Not pushed. {folder} is being recorded to, repaired or uploaded by another process: push when it has ended."
        ) from error
    except (OSError, JournalError):
        lock = None
    try:
        yield
    finally:
        if lock is not None:
            lock.release()


def _make_card(source: DatasetSource, repo_id: str, scratch: Path, options: PushOptions) -> dict[str, Path]:
    """The files that go up beside the dataset, by their names there."""
    from lerobot.datasets.utils import create_lerobot_dataset_card

    preview, film = None, options.preview
    if film is None:
        try:
            preview = film_preview(source, scratch / FILM)
            film = scratch / FILM
        except OutsideError as error:
            raise HubError(f"Not pushed. {error}") from error
        except Exception:  # a film is not worth an upload
            logger.warning("No film could be made for the dataset's card", exc_info=True)
    url = f"{HfApi().endpoint}/datasets/{repo_id}/resolve/main/{FILM}" if film is not None else None
    card = create_lerobot_dataset_card(
        tags=card_tags(source, options.tags),
        dataset_info=source.dataset.meta.info,
        license=options.license or "apache-2.0",
        repo_id=repo_id,
        dataset_description=describe_dataset(source, repo_id, url, preview),
    )
    card.save(scratch / CARD)
    return {CARD: scratch / CARD} | ({FILM: film} if film is not None else {})


def _push(
    repo_id: str, files: dict[str, Path], card: dict[str, Path], private: bool | None, check: Callable[[], None]
) -> str:
    from lerobot.datasets import CODEBASE_VERSION

    check_card(DatasetCard.load(card[CARD]), "dataset")
    check()
    repository = HubRepository(repo_id, "dataset", private)
    # LeRobot reads every file in data/: one that is no longer there must go.
    repository.commit(files, "Upload dataset", is_stale=lambda name: name.startswith(_CONTENT))
    repository.commit(card, "Upload card")
    check()  # before anyone loads this version
    repository.set_tag(CODEBASE_VERSION, move=True)
    return str(repository.url)


def _files(folder: Path) -> dict[str, Path]:
    """What goes up, by the names there."""
    names = {path.relative_to(folder): path for path in entries_below(folder) if path.is_file()}
    return {name.as_posix(): path for name, path in names.items() if name.parts[0] not in _LEFT_OUT}


def _stamps(files: dict[str, Path]) -> dict[str, tuple[int, int]]:
    """Size and time of change of each file [bytes, ns]: other tools write without a lock of ours."""
    stats = {name: path.stat() for name, path in files.items()}
    return {name: (stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()}


def _check_unchanged(folder: Path, before: dict[str, tuple[int, int]]) -> None:
    """Raise a HubError if a dataset is not what it was when its files were listed."""
    now = _stamps(_files(folder))
    changed = sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))
    if changed:
        raise HubError(f"it was changed meanwhile ({', '.join(changed[:3])}). Wait until nothing writes to it any more")
