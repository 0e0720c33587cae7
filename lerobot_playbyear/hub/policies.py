"""Uploads a policy: a checkpoint as LeRobot wrote it, with its card."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import get_policy_class
from lerobot.utils.constants import CHECKPOINTS_DIR, HF_LEROBOT_HOME

from lerobot_playbyear.compat import card_writer
from lerobot_playbyear.datasets.markdown import word
from lerobot_playbyear.hub.datasets import CARD, FILM
from lerobot_playbyear.hub.pushing import HubError, PushOptions, check_name, push_patiently, reason
from lerobot_playbyear.hub.repository import HubRepository, check_card
from lerobot_playbyear.hub.training_run import evaluation_of, find_checkpoint
from lerobot_playbyear.policy.card import write_card

_NO_RESULTS = "_No evaluation results have been provided for this policy yet._"  # LeRobot's template
_FILES = ("*.safetensors", "*.json", "*.yaml")  # as LeRobot uploads them


def push_policy(path: str | Path, repo_id: str, options: PushOptions) -> str:
    """Uploads a checkpoint of any LeRobot policy.

    Args:
        path: The folder `pretrained_model` of a checkpoint, or one that it is in: a checkpoint, or the output folder of a
            training, whose last checkpoint is taken.
        repo_id: Its name on the Hub, `user/name`.
        options: Whether it is private, and what its card says besides.

    Returns:
        Its address on the Hub.

    Raises:
        HubError: There is no checkpoint, it cannot be loaded, or it could not be uploaded.
    """
    check_name("policy.repo_id", repo_id)
    folder = find_checkpoint(Path(path))
    options.check()
    try:
        config = PreTrainedConfig.from_pretrained(folder)
        config.repo_id, config.device = repo_id, "cpu"
        config.license = options.license or (word(config.license) if config.license else None)
        config.tags = [*(config.tags or []), *(options.tags or [])]
        policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    except Exception as error:  # whatever LeRobot, JSON or safetensors raise
        raise HubError(f"Not pushed. The policy in {folder} cannot be loaded: {reason(error)}.") from error

    def push() -> str:
        repository = HubRepository(repo_id, "model", options.private)
        config.repo_id = repository.repo_id  # with the user's name, for the card
        with TemporaryDirectory() as scratch:
            files = {file.name: file for pattern in _FILES for file in folder.glob(pattern)}
            card = _make_card(policy, folder)
            if options.preview is not None:
                files[FILM] = options.preview
                url = f"{repository.api.endpoint}/{repository.repo_id}/resolve/main/{FILM}"
                card.text = f'\n<video controls width="480" src="{url}"></video>\n{card.text}'
            files[CARD] = Path(scratch) / CARD
            check_card(card, "model")
            card.save(files[CARD])
            repository.commit(files, "Upload policy")
        return str(repository.url)

    later = [f"--policy.path={path}", f"--policy.repo_id={repo_id}"]
    return push_patiently(push, f"The policy is complete in {folder}", later, options)


def push_checkpoint(folder: Path, repo_id: str, private: bool | None = None) -> None:
    """Uploads a checkpoint in the middle of a training, where and as LeRobot puts it, so that a run can resume from there.

    Args:
        folder: The checkpoint's; its name, the step, becomes a tag.
        repo_id: The policy's name on the Hub.
        private: Whether a repository that is created is private. None: as the account's default says.
    """
    repository = HubRepository(repo_id, "model", private)
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    files = {f"{CHECKPOINTS_DIR}/{folder.name}/{path.relative_to(folder).as_posix()}": path for path in paths}
    repository.set_tag(folder.name, repository.commit(files, f"checkpoint {folder.name}"))


def _make_card(policy: Any, folder: Path) -> ModelCard:
    config = policy.config
    training = TrainPipelineConfig.from_pretrained(folder) if (folder / TRAIN_CONFIG_NAME).is_file() else None
    dataset = training.dataset if training is not None else None
    meta = None
    if dataset is not None:
        root = Path(dataset.root) if dataset.root else HF_LEROBOT_HOME / dataset.repo_id
        if (root / "meta" / "info.json").is_file():
            meta = LeRobotDatasetMetadata(dataset.repo_id, root=root)
    card = write_card(
        card_writer(policy, config),
        config,
        dataset.repo_id if dataset is not None else None,
        config.type,
        config.license,
        config.tags,
        cfg=training,
        dataset_meta=meta,
    )
    figures = evaluation_of(folder)
    if figures is not None:
        result = f"Success in simulation: **{figures['pc_success']:.0f} %**, at step {figures['step']} of its training."
        card.text = card.text.replace(_NO_RESULTS, result)
    return card
