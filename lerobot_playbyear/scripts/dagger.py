"""playbyear-dagger: an expert corrects a policy while it works, and the policy learns from it (HG-DAgger).

    playbyear-dagger --policy.path=outputs/train/checkpoints/last/pretrained_model \
        --demos.repo_id=me/demos --demos.root=outputs/demos \
        --interventions.repo_id=me/corrections --interventions.root=outputs/corrections \
        --env.type=playbyear --env.task=OccludedGrasp-v0 --episodes=25 --output_dir=outputs/dagger
    playbyear-dagger --resume=true --output_dir=outputs/dagger
"""

import sys
from pathlib import Path

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_playbyear.dagger import DaggerConfig, DaggerError, run_dagger
from lerobot_playbyear.dagger.config import with_saved_options
from lerobot_playbyear.hub.client import patient_hub
from lerobot_playbyear.teleoperation import config as _teleop  # noqa: F401  (registers --expert.type=teleop)
from lerobot_playbyear.training.heap import keep_freed_memory


@parser.wrap()
def dagger(cfg: DaggerConfig) -> Path:
    """Run HG-DAgger with options from the command line."""
    return run_dagger(cfg)


def main() -> None:
    """The command."""
    keep_freed_memory()
    register_third_party_plugins()
    sys.argv[1:] = with_saved_options(sys.argv[1:])
    try:
        with patient_hub():
            dagger()
    except DaggerError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("Interrupted. Go on with --resume=true and the same --output_dir.")


if __name__ == "__main__":
    main()
