"""playbyear-train: lerobot-train with the dataset in memory.

Takes lerobot-train's options, keeps its output folder and its checkpoints (each resumes the
other's), and trains through LeRobot's own update. The dataset is read once and kept in memory.

    playbyear-train --preset=cpu --dataset.repo_id=me/demos --dataset.root=outputs/demos \\
        --output_dir=outputs/train
    accelerate launch --multi_gpu --num_processes=2 $(which playbyear-train) ...
    playbyear-train --resume=true --steps=6000 \\
        --config_path=outputs/train/checkpoints/last/pretrained_model/train_config.json

What is trained on
  --dataset.repo_id=...        name of the dataset, user/name; needed
  --dataset.root=null          its folder; else LeRobot's cache, or the Hub
  --dataset.episodes=null      only these, like [0,1,2]
  --dataset.eval_split=0.0     share of the episodes that are held out
  --store=auto                 where frames are kept: memory, disk (files, found again by the
                               next run), or auto: memory where they fill half of it at most
  --store.device=null          cpu or cuda; else cuda where there is room

What is trained
  --preset=null                named defaults: cpu (two cores), gpu (5 minutes on an H200), paper
  --policy.type=...            playbyear, or any other policy that LeRobot knows
  --policy.path=...            go on from a checkpoint instead, a folder or a name on the Hub
  --policy.device=null         cuda, mps or cpu; else the best there is
  --policy.use_audio=true      whether it hears (of the policy playbyear, like the next two)
  --policy.image_size=224      its pictures' height and width [pixels]
  --policy.n_supervised_steps=8    windows of a run that share their frames

How
  --steps=100000               updates
  --batch_size=8               runs of windows per update
  --seed=1000                  of all random numbers
  --policy.use_amp=false       bfloat16 or float16 where the machine computes in it
  --compile=false              compile the network first; meant for a GPU, not measured yet

What comes of it
  --output_dir=null            folder of checkpoints and figures; must not be there yet
  --log_freq=200               updates between two lines of figures
  --save_freq=20000            updates between two checkpoints
  --eval_steps=0               updates between two losses of the held-out episodes; 0: none
  --env.type=...               environment to try the policy in, like playbyear
  --env_eval_freq=20000        updates between two such trials; 0: none
  --eval.n_episodes=50         episodes of a trial
  --policy.push_to_hub=true    upload the last checkpoint, as --policy.repo_id
  --wandb.enable=false         report to Weights & Biases
  --resume=false               go on with the run that --config_path names

--help=all lists all of LeRobot's options.
"""

import sys

from lerobot_playbyear.scripts.command import check_local_dataset, run_command, run_with_lerobot
from lerobot_playbyear.training.command_line import with_long_store


def main() -> None:
    """The command."""
    again = "Interrupted. Go on from the last checkpoint with --resume=true --config_path=<its train_config.json>."
    run_command("playbyear-train", __doc__, _train, again)


def _train() -> None:
    from lerobot_playbyear.training.command_line import apply_preset

    sys.argv[1:] = apply_preset(with_long_store(sys.argv[1:]))
    from lerobot_playbyear.training.acceleration import keep_freed_memory
    from lerobot_playbyear.training.config import PlaybyearTrainConfig

    keep_freed_memory()

    def train(cfg: PlaybyearTrainConfig) -> None:
        check_local_dataset(cfg.dataset.repo_id, cfg.dataset.root)
        from lerobot_playbyear.training.train import train as learn

        learn(cfg)

    run_with_lerobot(train)


if __name__ == "__main__":
    main()
