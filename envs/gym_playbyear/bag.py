"""An opaque bag with hinged, springy walls on a soft heap, and the rule that it must not be torn.

The walls are stiff panels on damped spring hinges, one at the foot and one halfway up: they give way to the hand, and the
camera sees it. The bag's bottom lies on a springy heap of paper whose height nobody sees. An arm this stiff does not notice
that it touches something so soft.
"""

from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE_TOP
from gym_playbyear.rules import Rule
from gym_playbyear.task import Prop

BAG = "bag"
BAG_MIDDLE = (0.0, 0.0)  # m, world
HALF_SIZE = (0.085, 0.14)  # m, along x and y
HEIGHT = 0.18  # m
RIM = TABLE_TOP + HEIGHT  # m, world
BOTTOM_THICKNESS = 0.004  # m
_WALL = 0.0015  # m, half its thickness
_STIFFNESS = (2.0, 0.8)  # Nm/rad of the hinges at the foot and halfway up
_DAMPING = (0.06, 0.02)  # Nms/rad
_COLOURS = ("0.70 0.52 0.33 1", "0.75 0.57 0.38 1")  # of the lower and the upper halves: brown paper
_PARTS = ("foot", "half")
_SEEN = 0.005  # rad
_BOTTOM_STIFFNESS, _BOTTOM_DAMPING = 1500.0, 40.0  # N/m, Ns/m
_BOTTOM_PRESSED = 0.004  # m: so far down it crackles as a wall that bends by one radian


def bag() -> Prop:
    """The bag, standing on the table. Its bottom is at the height that the joint `bottom` says [m, above the table]."""
    walls, bends = "", [("bottom", 1.0 / _BOTTOM_PRESSED)]
    for name, axis, sign in (("front", 0, 1), ("back", 0, -1), ("left", 1, 1), ("right", 1, -1)):
        walls += _wall(name, axis, sign)
        bends += [(f"{name}_foot", 1.0), (f"{name}_half", 1.0)]
    x, y = HALF_SIZE
    half = BOTTOM_THICKNESS / 2
    bottom = f"""
      <body name="bottom">
        <joint name="bottom" type="slide" axis="0 0 1" stiffness="{_BOTTOM_STIFFNESS}" damping="{_BOTTOM_DAMPING}"
               range="0 0.15"/>
        <geom type="box" size="{x - 0.003} {y - 0.003} {half}" pos="0 0 {half}" mass="0.05" friction="0.6 0.005 0.0001"
              rgba="{_COLOURS[0]}"/>
      </body>"""
    body = f'<body name="{BAG}" pos="{BAG_MIDDLE[0]} {BAG_MIDDLE[1]} {TABLE_TOP}">{bottom}{walls}</body>'
    return Prop(BAG, body, material="bag", bends=tuple(bends))


def _wall(name: str, axis: int, sign: int) -> str:
    """Two panels, one above the other; `axis` is that of its normal."""
    half = HEIGHT / 4
    place, size = [0.0, 0.0, 0.0], [HALF_SIZE[0], HALF_SIZE[1], half]
    place[axis], size[axis] = sign * (HALF_SIZE[axis] + _WALL), _WALL
    hinge = "0 1 0" if axis == 0 else "-1 0 0"  # a positive angle bends the wall along its axis
    panels = [
        f'<geom type="box" size="{size[0]} {size[1]} {size[2]}" pos="0 0 {half}" mass="0.02" friction="0.3 0.005 0.0001" '
        f'rgba="{colour}"/>'
        for colour in _COLOURS
    ]
    joints = [
        f'<joint name="{name}_{part}" axis="{hinge}" stiffness="{stiffness}" damping="{damping}" range="-1.2 1.2"/>'
        for part, stiffness, damping in zip(_PARTS, _STIFFNESS, _DAMPING, strict=True)
    ]
    return f"""
      <body name="{name}_lower" pos="{place[0]} {place[1]} {place[2]}">{joints[0]}{panels[0]}
        <body name="{name}_upper" pos="0 0 {2 * half}">{joints[1]}{panels[1]}</body>
      </body>"""


def walls_seen(env: Any) -> dict[str, np.ndarray]:
    """What the camera shows of the moment: how the eight panels are bent [rad], to a tenth of a pixel or so."""
    angles = [
        env.data.joint(f"{wall}_{part}").qpos[0] for wall in ("front", "back", "left", "right") for part in _PARTS
    ]
    return {"bag_bend": np.round(np.array(angles) / _SEEN) * _SEEN}


def set_bottom(env: Any, height: float) -> None:
    """Begins an episode with the bag's bottom at a height above the table [m], at rest."""
    joint = env.model.joint("bottom")
    env.data.qpos[joint.qposadr[0]] = height
    env.model.qpos_spring[joint.qposadr[0]] = height


def bottom_height(env: Any) -> float:
    """Where the bag's bottom is, its upper side [m, world]."""
    return float(env.data.body("bottom").xpos[2] + BOTTOM_THICKNESS)


class Torn(Rule):
    """The hand pushed the bag's bottom or a wall so hard that it tears (the paper ends what damages the bag, too).

    Args:
        limit: Net force between hand and bag [N].
    """

    name = "torn"

    def __init__(self, limit: float):
        self.limit = limit

    def applies(self, env: Any) -> bool:
        return bool(env.contact_forces[f"gripper-{BAG}"] > self.limit)
