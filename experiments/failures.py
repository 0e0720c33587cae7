"""What went wrong first: the cube was not found, the hop missed it, or it was put down beside the tray.

    python -m experiments.failures --task=OccludedPickPlace-v1 --checkpoint=outputs/train/checkpoints/last/pretrained_model
    python -m experiments.failures --task=OccludedPickPlace-v1        # the expert's

`--films=FOLDER` also films the first episode of each kind, with sound.

Told from what the simulator knows: `pressed` alone says that the hand came down on the cube, not that it had dropped it beside
the tray before. Beside it stands for what the scripted expert would have taken over first, had it watched. The episodes are of
seeds on which choices are made. Prints a line per episode and a table.
"""

from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.utils.random_utils import set_seed

from experiments.landings import CUBES, HopRecorder, asked_for, parser_of
from gym_playbyear.tasks.occluded import PLACE_TOLERANCE
from lerobot_playbyear.episodes.experts import ScriptedExpert
from lerobot_playbyear.episodes.play import Actor, Episode, play
from lerobot_playbyear.film.rollout_film import write_episode_film

LIFTED_M = 0.01
BESIDE_MM = 6.0
"""A hop that ends further beside the cube's middle has missed: open fingers leave 7 mm on either side of the cube."""
N_APART = 3
"""Steps without contact after which a held cube was let go, and not only held loosely."""


class FailureRecorder(HopRecorder):
    """Notes also what became of the cube in every step of an episode of a cube task."""

    def reset(self, **options: Any) -> Any:
        self._cubes: list[tuple[float, float, float]] = []
        self._held: list[bool] = []
        result = super().reset(**options)
        self._first_z = float(self.env.unwrapped.position("cube")[2])  # type: ignore[attr-defined]
        return result

    def step(self, action: Any) -> Any:
        result, world = super().step(action), self.env.unwrapped
        self._cubes.append(tuple(world.position("cube")))  # type: ignore[attr-defined]
        self._held.append(world.contact_forces["gripper-cube"] > 0)  # type: ignore[attr-defined]
        return result

    def let_go(self) -> float | None:
        """How far the cube was from the tray's middle when it was first let go, negative before the tray [mm]; None: never."""
        cubes, held = np.array(self._cubes), np.array(self._held)
        lifted = held & (cubes[:, 2] > self._first_z + LIFTED_M)
        apart = np.convolve(~held, np.ones(N_APART), "valid") == N_APART  # (T - 2,) from this step on
        after = np.flatnonzero(apart & (np.cumsum(lifted) > 0)[: len(apart)])
        tray = getattr(self.env.unwrapped, "bin_position", None)
        if not len(after) or tray is None:
            return None
        beyond = tray[1] - cubes[after[0], 1]  # cubes are carried towards smaller y
        across = abs(cubes[after[0], 0] - tray[0])
        return float(1000 * (beyond if abs(beyond) >= across else across))

    def first_mistake(self) -> str:
        """In a few words, the same for mistakes of one kind; empty where the episode succeeded."""
        let_go = self.let_go()
        lifted = any(
            held and z > self._first_z + LIFTED_M for held, (_, _, z) in zip(self._held, self._cubes, strict=True)
        )
        if self.end == "success":
            return ""
        if let_go is not None:
            is_beside = abs(let_go) > 1000 * PLACE_TOLERANCE
            return "put down beside the tray" if is_beside else "let go over the tray, and no success"
        if lifted:
            return "held, and no success"
        if not any(self._held):
            return "never touched"
        landing = self.landing()
        if landing is not None and abs(landing.offset_mm) > BESIDE_MM:
            return "came down beside the cube"
        return "touched, and not lifted"


class Onlooker(ScriptedExpert):
    """Notes for what it would first have taken over, and never does."""

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self.reason = "nothing"

    def wants_control(self, observation: Any, policy_action: np.ndarray) -> bool:
        if self.reason == "nothing" and super().wants_control(observation, policy_action):
            self.reason = str(self._gate.reason)
        return False


def table_of(seen: dict[str, Counter[str]], n: int) -> str:
    """In Markdown, the most frequent mistake first.

    Args:
        seen: Of each first mistake, for what the expert would have taken over.
        n: Episodes in all.
    """
    rows = ["| first mistake | episodes | taken over first for |", "|---|---|---|"]
    for mistake, reasons in sorted(seen.items(), key=lambda item: -item[1].total()):
        told = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        rows.append(f"| {mistake or 'none: success'} | {reasons.total()} of {n} | {told} |")
    return "\n".join(rows)


def played(
    env: gym.Env, actor: Actor, seed: int, onlooker: Onlooker, watch: Callable[[], Any] | None = None
) -> Episode:
    """An episode, the same one whenever it is played."""
    set_seed(seed)
    return play(env, actor, seed, expert=onlooker, watch=watch)


def film(env: gym.Env, actor: Actor, seed: int, path: Path) -> None:
    """Films an episode that was played before, with the same expert looking on: it draws from the episode's numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    episode = played(env, actor, seed, Onlooker(), env.render)
    write_episode_film(episode, path, round(env.metadata["render_fps"]))
    print(f"{path}: seed {seed}", flush=True)


def main() -> None:
    parser = parser_of(__doc__, CUBES[-1], n_episodes=50)
    parser.add_argument("--films", type=Path, help="folder for a film of each kind of mistake, and of a success")
    options = parser.parse_args()
    env, actor, seeds = asked_for(options)
    recorder, onlooker = FailureRecorder(env), Onlooker()
    seen: dict[str, Counter[str]] = defaultdict(Counter)
    let_go, first = [], {}
    for seed in seeds:
        played(recorder, actor, seed, onlooker)
        mistake, place = recorder.first_mistake(), recorder.let_go()
        seen[mistake][onlooker.reason] += 1
        first.setdefault(mistake, seed)
        where = "" if place is None else f", let go {place:.0f} mm from the tray's middle"
        print(f"{seed} {recorder.end or 'time'}: {mistake or 'no mistake'}{where}", flush=True)
        let_go += [] if place is None else [place]
    if options.films is not None:
        for mistake, seed in first.items():
            name = mistake.replace(",", "").replace(" ", "_") or "success"
            film(recorder, actor, seed, options.films / f"{name}.mp4")
    recorder.close()
    print(f"\n{table_of(seen, len(seeds))}")
    if let_go:
        print(
            f"\nLet go {np.mean(let_go):.0f} ± {np.std(let_go):.0f} mm from the tray's middle, {len(let_go)} episodes."
        )


if __name__ == "__main__":
    main()
