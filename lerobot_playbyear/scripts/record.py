"""playbyear-record: a script or a person demonstrates a task; a LeRobotDataset with sound.

Only successful episodes are kept. Each is safe on the disk as soon as it is saved.

    playbyear-record --env.type=playbyear --env.task=OccludedGrasp-v1 --seed=0 \\
        --dataset.repo_id=me/demos --dataset.root=outputs/demos --dataset.num_episodes=50
    playbyear-record ... --expert.type=teleop          # a person, in a window

  --env.type=...               the environment, like playbyear; needed
  --env.task=...               its task, such as OccludedGrasp-v1 or TellApart-v1
  --expert.type=...            who demonstrates: scripted (the environment's own, default), teleop
  --expert.teleop.type=...     what a person moves the arm with: keyboard_window, gamepad, ...
  --dataset.repo_id=...        the dataset's name, user/name; needed
  --dataset.root=null          its folder; else LeRobot's cache
  --dataset.num_episodes=50    how many episodes it shall have
  --dataset.video=false        pictures as video; otherwise each is stored without loss
  --dataset.push_to_hub=false  upload it when it is complete
  --seed=0                     of the first attempt; the others take the next ones
  --num_workers=null           processes that roll out, 0: this one; else one per core, at most 8
  --resume=false               append to a dataset that is there, up to --dataset.num_episodes

--help=all lists all of LeRobot's options.
"""

from lerobot_playbyear.scripts.command import run_command, run_with_lerobot


def main() -> None:
    """The command."""
    again = "Interrupted. The saved episodes are safe; go on with the same command and --resume=true."
    run_command("playbyear-record", __doc__, _record, again)


def _record() -> None:
    # Here, because the processes that roll out import this module, and start in 2 seconds without LeRobot.
    from lerobot_playbyear.recording.record import record

    run_with_lerobot(record)


if __name__ == "__main__":
    main()
