"""Uploads a dataset: LeRobot's files, its card with a film beside it, and the tag that LeRobot looks for."""

import logging
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from huggingface_hub import HfApi

from lerobot_playbyear.datasets.confines import OutsideError, check_links
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, entries_below
from lerobot_playbyear.hub.dataset_card import card_tags, describe_dataset
from lerobot_playbyear.hub.preview import film_preview
from lerobot_playbyear.hub.pushing import HubError, push_patiently
from lerobot_playbyear.hub.repository import HubRepository
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError

CARD = "README.md"
FILM = "preview.mp4"

_CONTENT = ("data/", "meta/", "videos/")
_LEFT_OUT = ("images", CARD, FILM, ".gitattributes", ".git", ".cache")  # scratch; what is made anew; what is the Hub's

logger = logging.getLogger(__name__)


def push_dataset(
    repo_id: str,
    root: str | Path | None = None,
    *,
    private: bool | None = None,
    tags: list[str] | None = None,
    license: str = "apache-2.0",
    film: Path | None = None,
) -> str:
    """Makes the Hub's repository hold exactly what is in a dataset's folder; its earlier content stays in its history.

    Whoever loads the dataset meanwhile gets the earlier version, until the tag of LeRobot's format moves at the end.

    Args:
        repo_id: Its name on the Hub, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
        private: Whether a repository that is created is private. None: as the account's default says.
        tags: For its card, besides LeRobot's and those of sound.
        license: Of the data, as the Hub names licences.
        film: An mp4 for the card. None: a film of one episode is made.

    Returns:
        Its address on the Hub.

    Raises:
        HubError: There is no whole dataset in the folder, or it could not be uploaded.
    """
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if "/" not in repo_id:
        raise HubError(f"dataset.repo_id={repo_id!r}: to push, give it as user/name.")
    if film is not None and not film.is_file():
        raise HubError(f"preview={film}: there is no such file.")
    try:
        source = DatasetSource.open(repo_id, folder)
        check_links(folder)
        files = _files(folder)
    except (InspectionError, OutsideError, OSError) as error:
        raise HubError(f"Not pushed. {error}") from error
    with TemporaryDirectory() as scratch:
        card = _make_card(source, repo_id, Path(scratch), film, tags, license)
        return push_patiently(
            partial(_push, repo_id, files, card, private),
            f"The dataset is complete in {folder}",
            _command(repo_id, root, private, tags, license, film),
        )


def _make_card(
    source: DatasetSource, repo_id: str, scratch: Path, film: Path | None, tags: list[str] | None, license: str
) -> dict[str, Path]:
    """The files that go up beside the dataset, by their names there."""
    from lerobot.datasets.utils import create_lerobot_dataset_card

    preview = None
    if film is None:
        try:
            preview = film_preview(source, scratch / FILM)
            film = preview.path
        except OutsideError as error:
            raise HubError(f"Not pushed. {error}") from error
        except Exception:  # a film is not worth an upload
            logger.warning("No film could be made for the dataset's card", exc_info=True)
    url = f"{HfApi().endpoint}/datasets/{repo_id}/resolve/main/{FILM}" if film is not None else None
    card = create_lerobot_dataset_card(
        tags=card_tags(source, tags),
        dataset_info=source.dataset.meta.info,
        license=license,
        repo_id=repo_id,
        dataset_description=describe_dataset(source, repo_id, url, preview),
    )
    card.save(scratch / CARD)
    return {CARD: scratch / CARD} | ({FILM: film} if film is not None else {})


def _push(repo_id: str, files: dict[str, Path], card: dict[str, Path], private: bool | None) -> str:
    from lerobot.datasets import CODEBASE_VERSION

    repository = HubRepository(repo_id, "dataset", private)
    # LeRobot reads every file in data/: one that is no longer there must go.
    repository.commit(files, "Upload dataset", is_stale=lambda name: name.startswith(_CONTENT))
    repository.commit(card, "Upload card")
    repository.set_tag(CODEBASE_VERSION, move=True)
    return str(repository.url)


def _files(folder: Path) -> dict[str, Path]:
    """What goes up, by the names there."""
    names = {path.relative_to(folder): path for path in entries_below(folder) if path.is_file()}
    return {name.as_posix(): path for name, path in names.items() if name.parts[0] not in _LEFT_OUT}


def _command(
    repo_id: str,
    root: str | Path | None,
    private: bool | None,
    tags: list[str] | None,
    license: str,
    film: Path | None,
) -> list[str]:
    command = ["playbyear-push", f"--dataset.repo_id={repo_id}"]
    command += [f"--dataset.root={root}"] if root is not None else []
    command += [f"--private={str(private).lower()}"] if private is not None else []
    command += [f"--tags=[{','.join(tags)}]"] if tags else []
    command += [f"--license={license}"] if license != "apache-2.0" else []
    return command + ([f"--preview={film}"] if film is not None else [])
