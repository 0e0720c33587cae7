"""Uploads a dataset: LeRobot's files, its card with a film beside it, and the tag that LeRobot looks for."""

import contextlib
import logging
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from huggingface_hub import CommitOperationAdd, HfApi
from huggingface_hub.errors import RevisionNotFoundError
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.utils import create_lerobot_dataset_card
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_playbyear.hub.dataset_card import card_tags, describe_dataset
from lerobot_playbyear.hub.preview import film_preview
from lerobot_playbyear.hub.pushing import HubError, push_patiently
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError

CARD = "README.md"
FILM = "preview.mp4"

_CONTENT = ["data/*", "meta/*", "videos/*"]
_LEFT_OUT = ["images/", CARD, FILM, ".gitattributes"]  # LeRobot's scratch folder; and what is made anew or is the Hub's

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
    except InspectionError as error:
        raise HubError(f"Not pushed. {error}") from error
    with TemporaryDirectory() as scratch:
        card = _make_card(source, repo_id, Path(scratch), film, tags, license)
        return push_patiently(
            partial(_push, HfApi(), repo_id, folder, card, private),
            f"The dataset is complete in {folder}",
            _command(repo_id, root, private, tags, license, film),
        )


def _make_card(
    source: DatasetSource, repo_id: str, scratch: Path, film: Path | None, tags: list[str] | None, license: str
) -> dict[str, Path]:
    """The files that go up beside the dataset, by their names there."""
    preview = None
    if film is None:
        try:
            preview = film_preview(source, scratch / FILM)
            film = preview.path
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


def _push(api: HfApi, repo_id: str, folder: Path, card: dict[str, Path], private: bool | None) -> str:
    url = api.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True)
    api.upload_folder(
        repo_id=repo_id,
        repo_type="dataset",
        folder_path=folder,
        commit_message="Upload dataset",
        ignore_patterns=list(_LEFT_OUT),
        delete_patterns=_CONTENT,  # LeRobot reads every file in data/: one that is no longer there must go
    )
    additions = [CommitOperationAdd(name, path) for name, path in card.items()]
    api.create_commit(repo_id, additions, repo_type="dataset", commit_message="Upload card")
    with contextlib.suppress(RevisionNotFoundError):
        api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
    api.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset", exist_ok=True)
    return str(url)


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
