"""playbyear-dagger: an expert corrects a policy while it works, and the policy learns from it.

HG-DAgger: the policy acts, the expert takes over where it goes wrong, and after every attempt the
policy is trained on demonstrations and corrections.

    playbyear-dagger --policy.path=outputs/train/checkpoints/last/pretrained_model \\
        --demos.repo_id=me/demos --demos.root=outputs/demos \\
        --interventions.repo_id=me/corrections --interventions.root=outputs/corrections \\
        --env.type=playbyear --env.task=OccludedGrasp-v1 --episodes=25 --output_dir=outputs/dagger
    playbyear-dagger --resume=true --output_dir=outputs/dagger

What goes in
  --policy.path=...            the policy to improve, a checkpoint's folder or a name on the Hub
  --demos.repo_id=...          the demonstrations it was trained on; half of each batch; needed
  --demos.root=null            their folder; else LeRobot's cache
  --env.type=...               where it acts, like playbyear
  --expert.type=...            who corrects: scripted (the environment's own, default), teleop
  --expert.teleop.type=...     what a person moves the arm with: keyboard_window, gamepad, ...
  --expert.person=...          with scripted: true for a script that reacts late, trembles and errs

Method
  --method.type=...            hg_dagger (default), no_handback, redo (shows all that the
                               policy failed at), robot_gated (the robot asks: ThriftyDAgger)
  --method.intervention_share=...   with robot_gated: of the steps in which it asks
  --skip_s=null                of every correction so much of its beginning is not learned from;
                               else as long as the policy remembers. 0: all of it is

Attempts
  --interventions.repo_id=...  the dataset of attempts with corrections, made or appended to; needed
  --interventions.root=null    its folder
  --episodes=25                attempts that it shall hold in the end; 0: none, see --updates
  --max_attempts=50            attempts in a row without a correction, after which the run ends
  --episode_seed=10000         of the first attempt; the others take the next ones

Training
  --updates_per_episode=100    updates after each attempt that is kept
  --warmup_episodes=5          attempts before the first update
  --updates=0                  with --episodes=0: updates on the corrections that are there
  --new_weights=false          with --episodes=0: begin anew, with all data at once
  --batch_size=24              runs of windows per update, half of them demonstrations
  --learning_rate=null         the largest of each round; else the policy's own
  --seed=1000                  of training, and of the first evaluation episode
  --store=auto                 where demonstrations are kept: memory, disk, or what suits

What comes out
  --output_dir=outputs/dagger  folder of checkpoints, figures and options
  --eval_every=5               rounds between two evaluations; 0: none
  --eval.n_episodes=50         episodes of an evaluation
  --wandb.enable=false         report to Weights & Biases
  --resume=false               go on with the run in --output_dir; options not given again stay

--help=all lists all of LeRobot's options.
"""

import sys

from lerobot_playbyear.scripts.command import check_local_dataset, run_command, run_with_lerobot
from lerobot_playbyear.training.command_line import with_long_store


def main() -> None:
    """The command."""
    again = "Interrupted. Go on with --resume=true and the same --output_dir."
    run_command("playbyear-dagger", __doc__, _correct, again)


def _correct() -> None:
    from lerobot_playbyear.dagger.config import DaggerConfig, with_saved_options
    from lerobot_playbyear.teleoperation import config as _teleop  # noqa: F401  (registers --expert.type=teleop)
    from lerobot_playbyear.training.acceleration import keep_freed_memory

    keep_freed_memory()
    sys.argv[1:] = with_saved_options(with_long_store(sys.argv[1:]))

    def correct(cfg: DaggerConfig) -> None:
        cfg.check()
        check_local_dataset(cfg.demos.repo_id, cfg.demos.root)
        from lerobot_playbyear.dagger.run import run_dagger

        run_dagger(cfg)

    run_with_lerobot(correct)


if __name__ == "__main__":
    main()
