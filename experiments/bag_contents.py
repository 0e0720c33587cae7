"""What the expert and blind scripts make of other things in the bag than keys, and how loud these are.

    python -m experiments.bag_contents

prints a table of KeyBag-Easy-v1 in markdown, from seed 2000 on; a quarter of an hour on one core. `--contents cloth` for one.
"""

import argparse

import gymnasium as gym
import numpy as np

from gym_playbyear.tasks.bag import CONTENTS, CONTENTS_KINDS

_TASK, _FIRST_SEED = "gym_playbyear:gym_playbyear/KeyBag-Easy-v1", 2000
_HEARD_FROM = 500.0  # Hz: below are hum and rumble


def successes(contents: str, n_episodes: int, script: str | None = None) -> float:
    """Share of episodes that the expert solves, or the blind script of that name."""
    env = gym.make(_TASK, sound="none", contents=contents).unwrapped
    solved = 0
    for seed in range(_FIRST_SEED, _FIRST_SEED + n_episodes):
        env.reset_physics(seed=seed)
        player, done, info = env.blind_baselines()[script] if script else env.scripted_expert(), False, {}
        while not done:
            _, terminated, truncated, info = env.step_physics(player.act())
            done = terminated or truncated
        solved += info["is_success"]
    return solved / n_episodes


def level_over_background(contents: str, n_episodes: int) -> float:
    """How much louder the loudest 20 ms are while open fingers touch the thing than the median 20 ms before, above 500 Hz [dB];
    median over episodes. The loudest 20 ms of a second of background are about 1 dB above their median."""
    env = gym.make(_TASK, image_size=8, contents=contents).unwrapped
    levels = []
    for seed in range(_FIRST_SEED, _FIRST_SEED + n_episodes):
        env.reset(seed=seed)
        expert, before, touches, is_open = env.scripted_expert(), [], [], env.finger_positions.sum()
        while expert.phase not in ("grasp", "lift", "hold"):
            observation, _, terminated, truncated, _ = env.step(expert.act())
            if terminated or truncated:
                break
            windows = _levels(observation["audio.gripper"], env._sample_rate)
            if env.contact_forces[f"gripper-{CONTENTS}"] > 0 and env.finger_positions.sum() > is_open - 0.001:
                touches.append(windows.max())
            elif not touches and env.contact_forces["gripper-bag"] == 0:
                before.append(np.median(windows))
        if touches and before:
            levels.append(max(touches) - np.median(before))
    env.close()
    return float(np.median(levels))


def _levels(samples: np.ndarray, rate: int) -> np.ndarray:
    """Of each 20 ms [dB]."""
    windows = samples.reshape(-1, rate // 50).astype(float)
    power = np.square(np.abs(np.fft.rfft(windows * np.hanning(windows.shape[1]), axis=1)))
    return np.asarray(10 * np.log10(power[:, int(_HEARD_FROM / 50) :].mean(axis=1) + 1e-9))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contents", nargs="*", default=list(CONTENTS_KINDS), choices=CONTENTS_KINDS)
    parser.add_argument("--n_expert", type=int, default=30)
    parser.add_argument("--n_blind", type=int, default=20)
    parser.add_argument("--n_heard", type=int, default=8)
    options = parser.parse_args()
    scripts = ("straight", "random", "spiral")
    print(
        f"| contents | expert ({options.n_expert}) | {' | '.join(scripts)} ({options.n_blind} each) | touch over background |"
    )
    print("|---|---|" + "---|" * len(scripts) + "---|")
    for kind in options.contents:
        shares = [successes(kind, options.n_expert)] if options.n_expert else []
        shares += [successes(kind, options.n_blind, script) for script in scripts] if options.n_blind else []
        row = [f"{share:.0%}" for share in shares] + [f"{level_over_background(kind, options.n_heard):.0f} dB"]
        print(f"| {kind} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
