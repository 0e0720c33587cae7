"""Is it the sound that the policy acts on? Play it a contact that is none, and mute one that is.

    python -m experiments.listening

takes the full policies that `experiments.ablations` trained. For every one, episodes of Occluded Grasp in which

- "false": in mid-sweep, at least 8 cm from the cube, it hears 0.2 s of the contact of another episode;
- "control": nothing is swapped at that moment;
- "muted": from the first touch on it hears another episode's quiet sweep.

A reaction is a stop of the sweep within 10 steps: three actions in a row whose y is below a third of what it was. The
figures do not depend on whether the episode would have succeeded.
"""

import json
import statistics
from pathlib import Path

import gymnasium as gym
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.import_utils import register_third_party_plugins

from experiments.ablations import STUDY
from experiments.protocol import DONOR_SEEDS, EVALUATION_SEEDS, RESULTS, command_line, save
from experiments.sound_probe import REACTION_STEPS, Donor, SoundProbe, Trial, make_donors
from experiments.training import Job
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.policy_actor import PolicyActor, load_policy_actor

TASK = "OccludedGrasp-v0"
ENV = PlaybyearEnvConfig(task=TASK)
MODES = ("false", "control", "muted")


def actor_of(checkpoint: Path, env: PlaybyearEnvConfig = ENV) -> PolicyActor:
    """A trained policy, ready to act in a task."""
    register_third_party_plugins()
    policy_cfg = PreTrainedConfig.from_pretrained(checkpoint)
    policy_cfg.pretrained_path = checkpoint
    return load_policy_actor(policy_cfg, env)


def listen(checkpoint: Path, mode: str, env: gym.Env, seeds: range, donors: list[Donor]) -> list[Trial]:
    """What a policy does when its sound is swapped, one trial per seed."""
    actor = actor_of(checkpoint)
    probe = SoundProbe(env, mode, donors)
    trials = []
    for seed in seeds:
        play(probe, actor, seed)
        trials.append(probe.trial)
    return trials


def summary(trials: list[Trial]) -> dict[str, float | int | None]:
    """The trials in which the moment came, as counts."""
    swapped = [trial for trial in trials if trial.swapped_at is not None]
    delays = [trial.reacted_after for trial in swapped if trial.reacted_after is not None]
    return {
        "n_episodes": len(trials),
        "n_trials": len(swapped),
        "n_reacted": sum(delay <= REACTION_STEPS for delay in delays),
        "n_closed_there": sum(trial.closed_there for trial in swapped),
        "median_steps_to_stop": statistics.median_high(delays) if delays else None,
    }


def main() -> None:
    parser = command_line(__doc__, "seeds")
    parser.add_argument("--policy", type=Path, help="another policy's folder instead of the ablations'")
    parser.add_argument("--n_episodes", type=int, default=len(EVALUATION_SEEDS))
    parser.add_argument("--first_seed", type=int, default=EVALUATION_SEEDS.start)
    options = parser.parse_args()

    env = env_spec(ENV).make()
    donors = make_donors(env, DONOR_SEEDS)
    episodes = range(options.first_seed, options.first_seed + options.n_episodes)
    policies = {f"seed{seed}": Job(STUDY, TASK, "full", seed).checkpoint for seed in options.seeds}
    for name, path in ({"policy": options.policy} if options.policy else policies).items():
        report = {mode: summary(listen(path, mode, env, episodes, donors)) for mode in MODES}
        print(name, json.dumps(report), flush=True)
        if not options.policy:
            save(RESULTS / "listening" / f"{TASK}-{name}.json", {"first_seed": episodes.start, **report}, indent=1)
    env.close()


if __name__ == "__main__":
    main()
