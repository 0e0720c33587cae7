"""An environment of your own that has a microphone, from recording to evaluation with LeRobot's commands.

    export PYTHONPATH=examples
    env="--env.discover_packages_path=gym_knock --env.type=knock"
    data="--dataset.repo_id=me/knock --dataset.root=outputs/knock/dataset"
    playbyear-record $env $data --dataset.num_episodes=20
    playbyear-train --preset=cpu $data --output_dir=outputs/knock/train
    lerobot-eval --policy.path=outputs/knock/train/checkpoints/last/pretrained_model $env --eval.n_episodes=10

Two files: `environment.py` is plain Gymnasium, `configuration.py` tells LeRobot about it. Installed as a distribution named
`lerobot_env_...` it is found without `--env.discover_packages_path`.
"""

from gymnasium.envs.registration import register

from gym_knock.environment import Knocking

__all__ = ["Knocking"]

register("gym_knock/Knock-v0", "gym_knock.environment:Knocking", max_episode_steps=60)
