"""Records a scripted expert, or a person (`--expert.type=teleop`), into a LeRobotDataset with sound.

    playbyear-record --env.type=playbyear --env.task=OccludedGrasp-v0 \
        --dataset.repo_id=user/grasp --dataset.root=outputs/grasp --dataset.num_episodes=50 --seed=0

LeRobot is imported inside `main`: the processes that roll out import this module and nothing of LeRobot, and so
start in 2 seconds instead of 30.
"""

import sys


def main() -> None:
    from lerobot.configs import parser
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_playbyear.recording.demonstrations import DemonstrationConfig, record_demonstrations
    from lerobot_playbyear.recording.record import RecordError

    @parser.wrap()
    def run(cfg: DemonstrationConfig) -> None:
        record_demonstrations(cfg)

    register_third_party_plugins()
    try:
        run()
    except RecordError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("Interrupted. The saved episodes are safe; go on with the same command and --resume=true.")


if __name__ == "__main__":
    main()
