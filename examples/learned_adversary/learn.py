"""The learned adversary: a deaf recurrent policy trained by reinforcement, and the same learner with the contact signal.

    python examples/learned_adversary/learn.py --task=OccludedGrasp-v1 --hears=false
    python examples/learned_adversary/learn.py --task=OccludedGrasp-v1 --hears=true

RecurrentPPO (sb3-contrib) on numbers: what a deaf policy gets of the arm and of the picture, with or without how hard the hand
touches. The reward is dense and knows where the cube is; the critic sees the truth. The player first imitates a teacher
(`--teacher`: the scripted expert, one of the deaf scripts, or none), then it explores. A run that was stopped goes on from its
last checkpoint. If the deaf learner exceeds the blind scripts, the task does not need hearing; if the one that hears does
not, the learner is too weak to prove anything.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numeric_task import DISCOUNT, NumericTask
from recurrent_player import (
    RecurrentPlayer,
    demonstrations,
    imitate,
    load_checkpoint,
    play_episode,
    save_checkpoint,
)
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from gym_playbyear.check.report import EXPERT

DEMONSTRATION_SEED = 10000
TRIAL_SEED = 20000  # of the episodes that the curve is measured on
FINAL_SEED = 80000  # of those that the result is measured on, as `python -m gym_playbyear.check` does
NO_TEACHER = "none"
_EXPERIENCE = 100_000  # s
_CRITIC_ALONE = 8  # updates in which only the critic learns, lest it spoil what the teacher taught


def make_model(arguments: Any) -> RecurrentPPO:
    """A new learner, with its environments."""

    def make() -> Monitor:
        options = environment_options(arguments)
        return Monitor(NumericTask(arguments.task, hears=arguments.hears, repeat=arguments.repeat, **options))

    model = RecurrentPPO(
        RecurrentPlayer,
        DummyVecEnv([make] * arguments.n_envs),
        n_steps=arguments.n_steps,
        batch_size=arguments.n_envs * arguments.n_steps // 4,
        n_epochs=4,
        learning_rate=arguments.learning_rate,
        gamma=DISCOUNT,
        gae_lambda=0.95,
        ent_coef=0.0,
        vf_coef=0.5,
        target_kl=0.02,
        seed=arguments.seed,
        device="cpu",
        policy_kwargs={"deviation": arguments.deviation},
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # else it makes a folder in the system's temporary one
    return model


def environment_options(arguments: Any) -> dict[str, Any]:
    """What the environment is made with, except its name."""
    options = {"horizon": arguments.horizon}
    return {name: value for name, value in options.items() if value is not None}


def teach(model: RecurrentPPO, env: NumericTask, arguments: Any) -> dict[str, Any]:
    """Imitation of the teacher, before any exploration."""
    if arguments.teacher == NO_TEACHER:
        return {"teacher": NO_TEACHER}
    seeds = range(DEMONSTRATION_SEED, DEMONSTRATION_SEED + arguments.n_demonstrations)
    solved = demonstrations(env, arguments.teacher, seeds)
    losses = imitate(model.policy, solved, arguments.imitation_updates, arguments.seed)
    return {"teacher": arguments.teacher, "n_solved": len(solved), "loss": float(np.mean(losses[-50:]))}


def freeze_player(model: RecurrentPPO, frozen: bool) -> None:
    for parameter in model.policy.own_parameters():
        parameter.requires_grad_(not frozen)


def learn(model: RecurrentPPO, env: NumericTask, arguments: Any, folder: Path, progress: dict[str, Any]) -> None:
    """Explores until so many steps of the task are done; a checkpoint and a line of metrics every now and then."""
    per_update = arguments.n_envs * arguments.n_steps * env.repeat
    while progress["steps"] < arguments.steps:
        began = time.perf_counter()
        for _ in range(min(arguments.updates_per_trial, -(-(arguments.steps - progress["steps"]) // per_update))):
            freeze_player(model, progress["n_updates"] < _CRITIC_ALONE and arguments.teacher != NO_TEACHER)
            model.learn(arguments.n_envs * arguments.n_steps, reset_num_timesteps=False, log_interval=None)
            progress["n_updates"] += 1
            progress["steps"] += per_update
        seconds = time.perf_counter() - began
        progress["seconds"] += seconds
        episodes = list(model.ep_info_buffer or [])
        point = {
            "steps": progress["steps"],
            "success": success_rate(model, env, range(TRIAL_SEED, TRIAL_SEED + arguments.trial_episodes)),
            "reward": float(np.mean([episode["r"] for episode in episodes])) if episodes else None,
            "deviation": model.policy.log_std.exp().mean().item(),
            "minutes": round(progress["seconds"] / 60, 1),
        }
        progress["curve"].append(point)
        save_checkpoint(model, folder, progress)
        print(json.dumps(point), flush=True)


def success_rate(model: RecurrentPPO, env: NumericTask, seeds: range) -> float:
    """Share of episodes that the player solves without chance."""
    model.policy.set_training_mode(False)
    return float(np.mean([play_episode(model.policy, env, seed) for seed in seeds]))


def run(arguments: Any) -> dict[str, Any]:
    """Teaches, explores, judges. Returns what `python -m gym_playbyear.check --learned` reads."""
    torch.set_num_threads(1)
    name = run_name(arguments)
    folder = arguments.folder or Path("outputs/learned_adversary") / name
    model = make_model(arguments)
    env = NumericTask(arguments.task, hears=arguments.hears, repeat=arguments.repeat, **environment_options(arguments))
    arguments.steps = arguments.steps or round(_EXPERIENCE * env.task.facts.control_hz)
    progress = load_checkpoint(model, folder)
    if progress is None:
        progress = {"steps": 0, "n_updates": 0, "seconds": 0.0, "curve": [], "imitation": teach(model, env, arguments)}
        rate = success_rate(model, env, range(TRIAL_SEED, TRIAL_SEED + arguments.trial_episodes))
        progress["curve"].append({"steps": 0, "success": rate})
        save_checkpoint(model, folder, progress)
        print(json.dumps({**progress["imitation"], **progress["curve"][0]}), flush=True)
    learn(model, env, arguments, folder, progress)
    solved = [play_episode(model.policy, env, FINAL_SEED + i) for i in range(arguments.episodes)]
    result = {
        "name": name,
        "task": arguments.task,
        "hears": arguments.hears,
        "successes": sum(solved),
        "n_episodes": len(solved),
        "first_seed": FINAL_SEED,
        "options": {key: str(value) for key, value in vars(arguments).items() if key not in ("output", "folder")},
        **progress,
    }
    output = arguments.output or folder / "check.json"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(result, indent=1) + "\n")
    print(f"{name}: {sum(solved)} of {len(solved)}, after {progress['steps']} steps")
    return result


def run_name(arguments: Any) -> str:
    """Names a run's folder and result."""
    sense = "hears" if arguments.hears else "deaf"
    return f"{arguments.task}-{sense}-{arguments.teacher}-seed{arguments.seed}"


def parser():
    """The command line."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--task", default="OccludedGrasp-v1")
    made.add_argument(
        "--hears", type=lambda text: text.lower() == "true", default=False, help="true: with the contact signal"
    )
    made.add_argument("--teacher", default=EXPERT, help=f"{EXPERT}, {NO_TEACHER}, or one of the task's deaf scripts")
    made.add_argument(
        "--steps", type=int, help="of the task; by default two million at 20 Hz, and in proportion at other rates"
    )
    made.add_argument("--seed", type=int, default=1)
    made.add_argument("--episodes", type=int, default=100, help="that judge the result")
    made.add_argument("--horizon", type=int)
    made.add_argument("--repeat", type=int, help="steps of the task for each action; by default the task's")
    made.add_argument("--n_demonstrations", type=int, default=200)
    made.add_argument("--imitation_updates", type=int, default=1500)
    made.add_argument("--n_envs", type=int, default=16)
    made.add_argument("--n_steps", type=int, default=128, help="actions of each environment between updates")
    made.add_argument("--updates_per_trial", type=int, default=10, help="between two points of the curve")
    made.add_argument("--trial_episodes", type=int, default=40, help="of a point of the curve")
    made.add_argument("--learning_rate", type=float, default=1e-4)
    made.add_argument("--deviation", type=float, default=0.04, help="of the actions it explores with, to begin with")
    made.add_argument("--folder", type=Path, help="of the checkpoint; by default outputs/learned_adversary/NAME")
    made.add_argument("--output", type=Path, help="of the result; by default check.json in that folder")
    return made


if __name__ == "__main__":
    run(parser().parse_args())
