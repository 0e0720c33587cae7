"""`playbyear-push`: a dataset or a policy goes to the Hub, with its card."""

from dataclasses import dataclass, field

from lerobot_playbyear.hub.datasets import push_dataset
from lerobot_playbyear.hub.pushing import HubError, PushOptions


@dataclass
class PushDatasetConfig:
    """The dataset.

    Args:
        repo_id: Its name on the Hub, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
    """

    repo_id: str | None = None
    root: str | None = None


@dataclass
class PushPolicyConfig:
    """The policy.

    Args:
        path: The folder of a checkpoint, or the output folder of a training, whose last checkpoint is taken.
        repo_id: Its name on the Hub, `user/name`.
    """

    path: str | None = None
    repo_id: str | None = None


@dataclass
class PushConfig(PushOptions):
    """Options of `playbyear-push`. One of `dataset` and `policy` has to be given.

    Args:
        dataset: The dataset to upload.
        policy: The policy to upload.
        private: Whether a repository that is created is private. True: nothing goes to one that is there and public. None: as
            the account's default says.
        tags: For the card, besides those that it gets by itself.
        license: As the Hub names licences. None: the policy's own, or else apache-2.0.
        preview: An mp4 that the card shows, as `playbyear-video` makes them. None: of a dataset, one is made.
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

    from lerobot_playbyear.hub.policies import push_policy

    register_third_party_plugins()
    url = push_policy(policy.path, policy.repo_id, cfg)
    print(f"Policy: {url}\nTry it anywhere: lerobot-eval --policy.path={policy.repo_id} --env.type=...")
    return url
