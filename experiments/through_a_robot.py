"""A policy of the simulated task, acting through robot, sound server, PortAudio and wall clock.

    python -m experiments.through_a_robot --policy.path=outputs/train/checkpoints/last/pretrained_model --n_episodes=50
    python -m experiments.through_a_robot --policy.path=... --where=simulator
    python -m experiments.through_a_robot --record_to=outputs/demos_robot --n_episodes=50 --first_seed=0

The arm runs in a process of its own, in real time, and its sound is played into a PulseAudio server; what the policy hears
comes back through PortAudio as from any sound card. With `--mute=true` nothing is played. Debian: pulseaudio,
libportaudio2, libasound2-plugins; `pip install sounddevice`.
"""

import json
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.import_utils import register_third_party_plugins

FPS, RATE = 20, 16000


@dataclass
class Options:
    """Options of this experiment.

    Args:
        policy: The policy, `--policy.path=...`.
        task: The task.
        where: `robot`, or `simulator`: the same seeds without wall clock and sound server.
        first_seed, n_episodes: The episodes.
        mute: Whether the robot's sound is not played.
        latency_s: The microphone's.
        record_to: Instead of an evaluation, a script demonstrates through the robot: the dataset's folder.
        output: Where the figures go.
    """

    policy: PreTrainedConfig | None = None
    task: str = "OccludedGrasp-v0"
    where: str = "robot"
    first_seed: int = 90000
    n_episodes: int = 50
    mute: bool = False
    latency_s: float = 0.0
    record_to: Path | None = None
    output: Path = Path("outputs/through_a_robot.json")

    def __post_init__(self) -> None:
        path = parser.get_path_arg("policy")
        if path:
            self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=parser.get_cli_overrides("policy") or [])
            self.policy.pretrained_path = Path(path)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        return ["policy"]


def bench(cfg: Options, stack: ExitStack) -> str:
    """Sound server and arm, until the stack is closed; the arm's socket. Its microphone is the sound card `gripper`."""
    from robot_factory import simulation
    from sound_server import Player, SoundServer

    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir="/tmp")))
    server = stack.enter_context(SoundServer(folder, {"gripper": 1}, RATE))
    if cfg.mute:
        stack.enter_context(Player(server.fifo("gripper"), 1, RATE, noise=2.0))
    fifo = "" if cfg.mute else server.fifo("gripper")
    return stack.enter_context(simulation(folder, fifo, f"--task={cfg.task}"))


def demonstrate(cfg: Options) -> dict[str, Any]:
    """Records the script's demonstrations through the robot, with the command that a person would use."""
    from robot_factory import with_sim_robot

    assert cfg.record_to is not None
    with ExitStack() as stack:
        socket = bench(cfg, stack)
        microphone = (
            f"{{gripper: {{type: portaudio, device: gripper, sample_rate: {RATE}, latency_s: {cfg.latency_s}}}}}"
        )
        command = [
            *(str(Path(sys.executable).parent / "playbyear-record"), "--env.type=playbyear_robot"),
            *("--env.robot.type=playbyear_sim", f"--env.robot.socket={socket}", f"--env.microphones={microphone}"),
            *(f"--env.fps={FPS}", "--env.task=Find and grasp the hidden cube", "--env.episode_s=15"),
            *("--env.frozen_s=0", "--env.console=none", "--expert.type=teleop"),
            *("--expert.teleop.type=playbyear_sim_leader", f"--expert.teleop.socket={socket}"),
            *("--expert.teleop.demonstrates=true", f"--seed={cfg.first_seed}", "--dataset.repo_id=experiments/robot"),
            *(f"--dataset.root={cfg.record_to}", f"--dataset.num_episodes={cfg.n_episodes}"),
        ]
        start = time.perf_counter()
        subprocess.run(command, check=True, env=with_sim_robot())
    return {"recorded": cfg.n_episodes, "seconds": round(time.perf_counter() - start, 1)}


def scene(cfg: Options, stack: ExitStack) -> tuple[gym.Env, Any, Any]:
    """Where the policy acts: the environment, its configuration, and what asks the simulation how it stands."""
    from lerobot_env_playbyear.config import PlaybyearEnvConfig

    simulated = PlaybyearEnvConfig(task=cfg.task)
    task_env = gym.make(
        f"{simulated.package_name}:{simulated.gym_id}", disable_env_checker=True, **simulated.gym_kwargs
    )
    stack.callback(task_env.close)
    if cfg.where == "simulator":
        return task_env, simulated, None
    socket = bench(cfg, stack)  # before PortAudio is first used
    from lerobot_robot_playbyear_sim import PlaybyearSimConfig
    from lerobot_robot_playbyear_sim.link import Link

    from lerobot_playbyear.microphones.config import PortAudioMicrophoneConfig
    from lerobot_playbyear.robots.config import RobotEnvConfig

    limit = task_env.get_wrapper_attr("_max_episode_steps")
    microphone = PortAudioMicrophoneConfig(device="gripper", sample_rate=RATE, latency_s=cfg.latency_s)
    config = RobotEnvConfig(
        task=task_env.get_wrapper_attr("task_description"),
        fps=FPS,
        robot=PlaybyearSimConfig(socket=socket),
        microphones={"gripper": microphone},
        episode_s=limit / FPS,
        console="none",
        frozen_s=0,  # a simulated camera without noise gives the same picture while nothing moves
    )
    env = stack.enter_context(closing(gym.make(config.gym_id, disable_env_checker=True, config=config)))
    link = Link(socket)
    stack.callback(link.close)
    return env, config, link


def evaluate(cfg: Options) -> dict[str, Any]:
    """Success of the policy over the seeds, and how well the time was kept."""
    from robot_factory import ScriptedConsole

    from lerobot_playbyear.episodes.play import play
    from lerobot_playbyear.episodes.policy_actor import load_policy_actor

    assert cfg.policy is not None, "give --policy.path"
    with ExitStack() as stack:
        env, env_cfg, link = scene(cfg, stack)
        actor = load_policy_actor(cfg.policy, _described(env_cfg, env))
        if link is not None:

            def judge(status: Any) -> str | None:
                now = link.ask("status")
                return (
                    "s" if now["success"] else "q" if now["failed"] else "p" if "Set the scene" in status.note else None
                )

            env.unwrapped._rig.console = ScriptedConsole(judge)
        outcomes, facts, start = [], [], time.perf_counter()
        for seed in range(cfg.first_seed, cfg.first_seed + cfg.n_episodes):
            episode = play(env, actor, seed)
            outcomes.append(episode.success)
            facts.append(episode.facts or {})
            print(
                f"seed {seed}: {episode.success} after {len(episode)} steps; {sum(outcomes)} of {len(outcomes)}",
                flush=True,
            )
        figures: dict[str, Any] = {"success_percent": 100 * float(np.mean(outcomes)), "n_episodes": len(outcomes)}
        figures |= {"where": cfg.where, "mute": cfg.mute, "seconds": round(time.perf_counter() - start, 1)}
        if link is not None:
            ticks = sum(each["ticks"] for each in facts)
            late = sum(each["late_ticks"] for each in facts)
            figures |= {
                "ticks": ticks,
                "late_ticks_percent": round(100 * late / ticks, 2),
                "worst_lateness_s": max(each["worst_lateness_s"] for each in facts),
                "drop_outs": sum(len(drops) for each in facts for drops in each["drop_outs"].values()),
            }
    return figures


def _described(env_cfg: Any, env: gym.Env) -> Any:
    if hasattr(env_cfg, "describe"):
        env_cfg.describe(env.observation_space, env.action_space)
    return env_cfg


@parser.wrap()
def main(cfg: Options) -> None:
    figures = evaluate(cfg) if cfg.record_to is None else demonstrate(cfg)
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    cfg.output.write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    register_third_party_plugins()
    main()
