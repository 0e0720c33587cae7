"""`playbyear-push`: a dataset or a policy goes to the Hub, with its card and a film.

Nobody knows of a request whose answer is lost whether it was done. So every step of an upload can be done again: a repository
or a tag that is there is what was wanted, and a commit names the one that it follows, so that the Hub refuses it where it has
been made already.
"""

import contextlib
import json
import logging
import shlex
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, ModelCard, RepoUrl, constants, get_token
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, OfflineModeIsEnabled, RevisionNotFoundError
from huggingface_hub.utils import validate_repo_id

from lerobot_playbyear.compat import card_writer
from lerobot_playbyear.datasets.checkpoint_steps import check_type
from lerobot_playbyear.datasets.errors import InputError, PlaybyearError, first_line
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, INFO_PATH, entries_below, parse_json
from lerobot_playbyear.datasets.info import check_links, check_links_out, check_there
from lerobot_playbyear.datasets.journal import locked
from lerobot_playbyear.datasets.markdown import word
from lerobot_playbyear.datasets.pictures import is_unsaved, named_pictures
from lerobot_playbyear.datasets.reader import SurveyedDataset
from lerobot_playbyear.hub.dataset_card import CARD, FILM, write_dataset_card

METRICS_NAME = "metrics.jsonl"
"""File in the output folder of a training with one JSON object per line."""

RUN_FOLDERS = ("checkpoints", "eval", "wandb")
"""What is written into in a run's folder."""

_WAITS_S = (1, 2, 5)  # between the tries of a step
_PASSING = (408, 409, 412, 425, 429)  # and all from 500; 412: a newer commit came before this one

_CONTENT = ("data/", "meta/", "videos/")
_LEFT_OUT = (CARD, FILM, ".gitattributes", ".git", ".cache")  # what is made again; what is the Hub's
_POLICY_FILES = (  # that saving makes
    *("config.json", "train_config.json", "model*.safetensors", "model.safetensors.index.json"),
    *("policy_preprocessor*", "policy_postprocessor*", "adapter_config.json", "adapter_model.safetensors"),
)
_NO_RESULTS = "_No evaluation results have been provided for this policy yet._"  # LeRobot's template

logger = logging.getLogger(__name__)


class HubError(PlaybyearError, RuntimeError):
    """Nothing was uploaded, or not all; the message says why, and how to go on."""


@dataclass
class PushOptions:
    """How something is uploaded.

    Args:
        private: Make a new repository private. True: refuse to upload to an existing public one. None: the account's default.
        tags: Tags for the card, in addition to the automatic ones.
        license: Licence, by its identifier on the Hub. None: the policy's own, or apache-2.0.
        preview: An mp4 for the card, such as one of `playbyear-video`. None: one is made for a dataset.
    """

    private: bool | None = None
    tags: list[str] | None = None
    license: str | None = None
    preview: Path | None = None

    def check(self) -> None:
        """Raises a HubError if there is no such film."""
        if self.preview is not None and not self.preview.is_file():
            raise HubError(f"preview={self.preview}: there is no such file.")
        if self.preview is not None and self.preview.suffix.lower() != ".mp4":
            raise HubError(f"preview={self.preview}: cards show mp4; give a film as playbyear-video makes them.")


@dataclass
class PushDatasetConfig:
    """The dataset.

    Args:
        repo_id: Name of the dataset on the Hub, `user/name`.
        root: Its folder. None: the one in LeRobot's cache.
    """

    repo_id: str | None = None
    root: str | None = None


@dataclass
class PushPolicyConfig:
    """The policy.

    Args:
        path: Folder of a checkpoint, or the output folder of a training, whose last checkpoint is uploaded.
        repo_id: Name of the policy on the Hub, `user/name`.
    """

    path: str | None = None
    repo_id: str | None = None


@dataclass
class PushConfig(PushOptions):
    """Options of `playbyear-push`. Give `dataset` or `policy`.

    Args:
        dataset: The dataset to upload.
        policy: The policy to upload.
        private: Make a new repository private. True: refuse to upload to an existing public one. None: the account's default.
        tags: Tags for the card, in addition to the automatic ones.
        license: Licence, by its identifier on the Hub. None: the policy's own, or apache-2.0.
        preview: An mp4 for the card, such as one of `playbyear-video`. None: one is made for a dataset.
    """

    dataset: PushDatasetConfig = field(default_factory=PushDatasetConfig)
    policy: PushPolicyConfig = field(default_factory=PushPolicyConfig)


def push(cfg: PushConfig) -> str:
    """Uploads what the options name.

    Returns:
        Its address on the Hub.

    Raises:
        HubError: An option is missing, there is nothing to upload, or it could not be uploaded.
    """
    dataset, policy = cfg.dataset, cfg.policy
    if (dataset == PushDatasetConfig()) == (policy == PushPolicyConfig()):
        raise HubError("Give either --dataset.repo_id (and --dataset.root), or --policy.path and --policy.repo_id.")
    if dataset.repo_id is not None:
        url = push_dataset(dataset.repo_id, dataset.root, cfg)
        print(f"Dataset: {url}\nLoad it anywhere: playbyear-inspect --dataset.repo_id={dataset.repo_id}")
        return url
    if dataset.root is not None:
        raise HubError(f"--dataset.root={dataset.root} needs --dataset.repo_id, the dataset's name on the Hub.")
    if policy.path is None:
        raise HubError("--policy.repo_id needs --policy.path, the folder of a checkpoint.")
    if policy.repo_id is None:
        raise HubError(f"--policy.path={policy.path} needs --policy.repo_id, the policy's name on the Hub.")
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    url = push_policy(policy.path, policy.repo_id, cfg)
    print(f"Policy: {url}\nTry it anywhere: lerobot-eval --policy.path={policy.repo_id} --env.type=...")
    return url


# A dataset


def push_dataset(repo_id: str, root: str | Path | None = None, options: PushOptions | None = None) -> str:
    """Makes the Hub's repository hold exactly what is in a dataset's folder; its earlier content stays in its history.

    Whoever loads the dataset meanwhile gets the earlier version, until the tag of LeRobot's format moves at the end.

    Args:
        repo_id: Its name on the Hub, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
        options: Whether it is private, and what its card says in addition. None: the usual.

    Returns:
        Its address on the Hub.

    Raises:
        HubError: There is no whole dataset in the folder, or it could not be uploaded.
        FolderLockedError: Somebody writes to it.
    """
    folder, options = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id, options or PushOptions()
    check_name("dataset.repo_id", repo_id, needs_user=True)
    options.check()
    try:
        check_there(folder)
    except InputError as error:
        raise HubError(f"Not pushed. {error}") from error
    with locked(folder), TemporaryDirectory() as scratch:
        try:
            dataset = SurveyedDataset.open(repo_id, folder)
            check_links(folder)
            named = named_pictures(folder, dataset.files, dataset.features)
            files = _files(folder, named)
            before = _stamps(files)
            license = options.license or "apache-2.0"
            card = write_dataset_card(dataset, repo_id, Path(scratch), options.tags, license, options.preview)
        except (InputError, OSError) as error:
            raise HubError(f"Not pushed. {error}") from error

        def upload() -> str:
            from lerobot.datasets import CODEBASE_VERSION

            _check_unchanged(folder, named, before)
            repository = _create(repo_id, "dataset", options.private)
            # LeRobot reads every file in data/: one that is no longer there must go.
            _commit(repository, files | card, "Upload dataset", stale=_CONTENT)
            _check_unchanged(folder, named, before)  # before anyone loads this version
            _tag(repository, CODEBASE_VERSION, move=True)
            return str(repository)

        later = [f"--dataset.repo_id={repo_id}", *([f"--dataset.root={root}"] if root is not None else [])]
        return _upload(upload, f"The dataset is complete in {folder}", later, options)


def _files(folder: Path, named: Collection[str]) -> dict[str, Path]:
    """What goes up, by the names there: of what lies below `images` that which rows name."""
    names = {path.relative_to(folder): path for path in entries_below(folder) if path.is_file()}
    own = {name for name in names if name.parts[0] not in _LEFT_OUT and not is_unsaved(name, named)}
    return {name.as_posix(): path for name, path in names.items() if name in own}


def _stamps(files: Mapping[str, Path]) -> dict[str, tuple[int, int]]:
    """Size and time of change of each file [bytes, ns]: other tools write without a lock of ours."""
    stats = {name: path.stat() for name, path in files.items()}
    return {name: (stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()}


def _check_unchanged(folder: Path, named: Collection[str], before: Mapping[str, tuple[int, int]]) -> None:
    """Raises a HubError if a dataset is not what it was when its files were listed."""
    now = _stamps(_files(folder, named))
    changed = sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))
    if changed:
        raise HubError(f"it was changed meanwhile ({', '.join(changed[:3])}). Wait until nothing writes to it any more")


# A policy


def push_policy(path: str | Path, repo_id: str, options: PushOptions) -> str:
    """Uploads a checkpoint of any LeRobot policy.

    Args:
        path: The folder `pretrained_model` of a checkpoint, or one that it is in: a checkpoint, or the output folder of a
            training, whose last checkpoint is taken.
        repo_id: Its name on the Hub, `user/name`.
        options: Whether it is private, and what its card says in addition.

    Returns:
        Its address on the Hub.

    Raises:
        HubError: There is no checkpoint, it cannot be loaded, or it could not be uploaded.
    """
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies import get_policy_class

    check_name("policy.repo_id", repo_id)
    folder = find_checkpoint(Path(path))
    options.check()
    try:
        check_links_out(folder)
        config = PreTrainedConfig.from_pretrained(folder)
        check_type(config.type)
        config.repo_id, config.device = repo_id, "cpu"
        config.license = options.license or (word(config.license) if config.license else None)
        config.tags = [*(config.tags or []), *(options.tags or [])]
        policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    except InputError as error:
        raise HubError(f"Not pushed. {error}") from error
    except Exception as error:  # whatever LeRobot, JSON or safetensors raise
        raise HubError(f"Not pushed. The policy in {folder} cannot be loaded: {reason(error)}.") from error

    def upload() -> str:
        repository = _create(repo_id, "model", options.private)
        config.repo_id = repository.repo_id  # with the user's name, for the card
        files = {file.name: file for pattern in _POLICY_FILES for file in folder.glob(pattern) if file.is_file()}
        card = _patiently(lambda: _policy_card(policy, folder))
        if options.preview is not None:
            files[FILM] = options.preview
            card.text = f'\n<video controls width="480" src="{repository}/resolve/main/{FILM}"></video>\n{card.text}'
        with TemporaryDirectory() as scratch:
            files[CARD] = Path(scratch) / CARD
            card.save(files[CARD])
            _commit(repository, files, "Upload policy")
        return str(repository)

    later = [f"--policy.path={path}", f"--policy.repo_id={repo_id}"]
    return _upload(upload, f"The policy is complete in {folder}", later, options)


def push_checkpoint(folder: Path, repo_id: str, private: bool | None = None) -> None:
    """Uploads a checkpoint in the middle of a training, where and as LeRobot puts it, so that a run can resume from there.

    A Hub that cannot be reached does not end the training: it is a warning.

    Args:
        folder: The checkpoint's, in `checkpoints/` of the run's; its name, the step, becomes a tag.
        repo_id: The policy's name on the Hub.
        private: Whether a repository that is created is private. None: as the account's default says.
    """
    try:
        check_links_out(folder)
        repository = _create(repo_id, "model", private)
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        files = {path.relative_to(folder.parents[1]).as_posix(): path for path in paths}
        _tag(repository, folder.name, _commit(repository, files, f"checkpoint {folder.name}"))
    except Exception as error:  # as in `_upload`
        logger.warning("%s was not uploaded (%s). Work goes on without", folder, reason(error))


def _policy_card(policy: Any, folder: Path) -> ModelCard:
    """LeRobot's card of a policy, with the success that its training measured.

    Raises:
        HubError: The Hub refuses it, as LeRobot asks there.
    """
    from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    from lerobot_playbyear.policy.card import write_card

    config, dataset, meta, training = policy.config, None, None, None
    if (folder / TRAIN_CONFIG_NAME).is_file():
        training = TrainPipelineConfig.from_pretrained(folder)
        dataset = training.dataset
    if dataset is not None:
        root = Path(dataset.root) if dataset.root else HF_LEROBOT_HOME / dataset.repo_id
        meta = LeRobotDatasetMetadata(dataset.repo_id, root=root) if (root / INFO_PATH).is_file() else None
    with _card_is_refused():
        own = (dataset.repo_id if dataset is not None else None, config.type, config.license, config.tags)
        card = write_card(card_writer(policy, config), config, *own, cfg=training, dataset_meta=meta)
    figures = evaluation_of(folder)
    if figures is not None:
        result = f"Success in simulation: **{figures['pc_success']:.0f} %**, at step {figures['step']} of its training."
        card.text = card.text.replace(_NO_RESULTS, result)
    return card


def find_checkpoint(path: Path) -> Path:
    """The folder `pretrained_model` in or at `path`.

    Raises:
        HubError: There is none.
    """
    from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

    wanted = (constants.CONFIG_NAME, constants.SAFETENSORS_SINGLE_FILE)
    for inside in ("", PRETRAINED_MODEL_DIR, f"{CHECKPOINTS_DIR}/{LAST_CHECKPOINT_LINK}/{PRETRAINED_MODEL_DIR}"):
        found = path / inside
        if all((found / name).is_file() for name in wanted):
            if not found.resolve().is_relative_to(path.resolve()):
                raise HubError(f"policy.path={path}: its last checkpoint is a link to {found.resolve()}. Give that.")
            return found
    raise HubError(
        f"policy.path={path}: there is no checkpoint with {' and '.join(wanted)}. Give the folder "
        f"`{PRETRAINED_MODEL_DIR}` of one, or the output folder of a training."
    )


def evaluation_of(checkpoint: Path) -> dict[str, float] | None:
    """The figures of the last evaluation in the simulator, if it was of this checkpoint.

    Args:
        checkpoint: A folder `<run>/checkpoints/<step>/pretrained_model`.
    """
    folder = checkpoint.resolve()
    state = folder.parent / "training_state" / "training_step.json"
    if not state.is_file():
        return None
    try:
        step = int(parse_json(state.read_bytes())["step"])
    except (ValueError, TypeError, LookupError, OverflowError):
        return None
    lines = [line for line in read_metrics(folder.parents[2]) if isinstance(line.get("pc_success"), int | float)]
    found = [line for line in lines if (line.get("kind"), line.get("step")) == ("eval", step)]
    return found[-1] if found else None


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """The lines of `METRICS_NAME` in a run's folder, without those that a kill or a full disk cut off."""
    path = run / METRICS_NAME
    lines = path.read_text().splitlines() if path.is_file() else []
    figures: list[dict[str, Any]] = []
    for line in lines:
        with contextlib.suppress(ValueError, TypeError):
            figures.append(dict(parse_json(line)))
    return figures


# Before long work whose end is an upload


def check_name(option: str, repo_id: str, needs_user: bool = False) -> None:
    """Whether there can be a repository of a name on the Hub.

    Args:
        option: What the name was given with, such as "policy.repo_id", for the message.
        repo_id: The name, `user/name`.
        needs_user: Whether the user's name may not be left out.

    Raises:
        HubError: There can be none.
    """
    if needs_user and "/" not in repo_id:
        raise HubError(f"{option}={repo_id!r}: to push, give it as user/name.")
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise HubError(f"{option}={repo_id!r} cannot be pushed: {first_line(error)}.") from error


def check_upload(option: str, repo_id: str, needs_user: bool = False) -> None:
    """As `check_name`, before long work; says if nobody is logged in, so that there is time to do that."""
    check_name(option, repo_id, needs_user)
    if not get_token():
        logger.warning("Nobody is logged in to the Hub: log in with `hf auth login` before the upload at the end.")


# The Hub, step by step


def _create(repo_id: str, kind: str, private: bool | None) -> RepoUrl:
    """A repository that is there from now on.

    Args:
        repo_id: Its name; without a user, the one who is logged in is its owner.
        kind: "model" or "dataset".
        private: As in `PushOptions`.

    Raises:
        HubError: It has to be private, and is public.
    """
    api = HfApi()
    repository = _patiently(lambda: api.create_repo(repo_id, repo_type=kind, private=private, exist_ok=True))
    if private and not _patiently(lambda: api.repo_info(repository.repo_id, repo_type=kind)).private:
        raise HubError(f"private=true, but {repository} is public. Make it private in its settings, or drop the option")
    return repository


def _commit(repository: RepoUrl, files: Mapping[str, Path], message: str, stale: tuple[str, ...] = ()) -> str:
    """Makes one commit, or none where all is there already. `HfApi.upload_folder` repeats one whose answer is lost.

    Args:
        repository: Where.
        files: What to upload, by the names there.
        message: Of the commit.
        stale: Folders of the repository, "data/", in which a file goes that is not among `files`.

    Returns:
        The name of the newest commit, which has the files.

    Raises:
        HubError: The Hub refuses the card among them; it says so before the files go up.
    """
    api, name, kind = HfApi(), repository.repo_id, repository.repo_type

    def commit() -> str:
        head = api.repo_info(name, repo_type=kind, revision="main").sha
        there = api.list_repo_files(name, repo_type=kind, revision=head) if stale else []
        gone = [old for old in there if old.startswith(stale) and old not in files]
        operations: list[CommitOperationAdd | CommitOperationDelete] = []
        operations += [CommitOperationAdd(path_in_repo, path) for path_in_repo, path in files.items()]
        operations += [CommitOperationDelete(old, is_folder=False) for old in gone]
        with _card_is_refused():
            made = api.create_commit(name, operations, repo_type=kind, commit_message=message, parent_commit=head)
        return str(made.oid)

    return _patiently(commit)


def _tag(repository: RepoUrl, tag: str, commit: str | None = None, move: bool = False) -> None:
    """Gives a commit a name; one that is there already stays where it is, unless it is to move.

    Args:
        repository: Where.
        tag: The name.
        commit: The commit. None: the newest.
        move: Take the name from the commit that has it.
    """
    api, name, kind = HfApi(), repository.repo_id, repository.repo_type
    if move:
        with contextlib.suppress(RevisionNotFoundError):
            _patiently(lambda: api.delete_tag(name, tag=tag, repo_type=kind))
    _patiently(lambda: api.create_tag(name, tag=tag, revision=commit, repo_type=kind, exist_ok=True))


@contextlib.contextmanager
def _card_is_refused() -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        if type(error) is not ValueError:  # an answer that is no JSON, or that says something else
            raise
        said = " ".join(str(error).split())
        raise HubError(f"the Hub refuses its card, give another license or other tags: {said}") from error


def _patiently[T](step: Callable[[], T]) -> T:
    """Does a step of an upload, and again while it fails for a passing reason. What it does may be done twice."""
    for wait_s in _WAITS_S:
        try:
            return step()
        except Exception as error:  # whatever the client, its Rust extension or the file system raise
            if not _is_passing(error):
                raise
            logger.warning("The Hub failed (%s); once more in %d s", reason(error), wait_s)
        time.sleep(wait_s)
    return step()


def _upload(upload: Callable[[], str], what: str, later: list[str], options: PushOptions) -> str:
    """Does an upload; a HubError says where what was to go up is safe, and the command that goes on.

    Args:
        upload: Does it; done again later, it sends what has not arrived.
        what: "The dataset is complete in outputs/demo".
        later: The options that name it for `playbyear-push`.
        options: Further ones.
    """
    try:
        return upload()
    except Exception as error:  # as in `_patiently`
        private = None if options.private is None else str(options.private).lower()
        tags = f"[{','.join(options.tags)}]" if options.tags else None
        given = {"private": private, "tags": tags, "license": options.license, "preview": options.preview}
        more = [f"--{name}={value}" for name, value in given.items() if value is not None]
        raise HubError(
            f"{what}, but it could not be uploaded: {reason(error)}. Upload it later with\n"
            f"  {shlex.join(['playbyear-push', *later, *more])}\nwhich does not send again what has arrived."
        ) from error


def reason(error: BaseException) -> str:
    """Why the Hub could not be used, in one line."""
    cause = _cause(error)
    if isinstance(cause, HubError):
        return str(cause).rstrip(".")
    if isinstance(cause, OfflineModeIsEnabled):
        return "the environment variable HF_HUB_OFFLINE forbids it"
    if isinstance(cause, httpx.TransportError):
        return f"{constants.ENDPOINT} cannot be reached ({type(cause).__name__}: {first_line(cause)})"
    if not isinstance(cause, HfHubHTTPError):
        return f"{type(error).__name__}: {first_line(error)}"
    if cause.response.status_code in (401, 403):  # 403 may be a quota
        said = (cause.server_message or "it does not say why").partition("\n")[0].rstrip(".")
        return (
            f"{constants.ENDPOINT} refused (status {cause.response.status_code}): {said}. If that is about the token, "
            "log in with `hf auth login`, with one that may write there"
        )
    return f"{constants.ENDPOINT} answered: {first_line(cause)}"


def _is_passing(error: BaseException) -> bool:
    cause = _cause(error)
    if isinstance(cause, HfHubHTTPError):
        return cause.response.status_code in _PASSING or cause.response.status_code >= 500
    # A RuntimeError is hf_xet's, for want of a better one; an answer that is no JSON is a proxy's.
    return isinstance(cause, httpx.TransportError | json.JSONDecodeError) or type(cause) is RuntimeError


def _cause(error: BaseException) -> BaseException:
    """What says most: of an error and its causes the first that is ours, the Hub's or the network's; else itself."""
    kinds, cause = (HubError, OfflineModeIsEnabled, HfHubHTTPError, httpx.TransportError), error
    while not isinstance(cause, kinds) and cause.__cause__ is not None:
        cause = cause.__cause__
    return cause if isinstance(cause, kinds) else error
