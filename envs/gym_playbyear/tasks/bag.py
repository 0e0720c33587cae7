"""An opaque bag with hinged, springy walls on a soft heap, what can be in it, and the rule that it must not be torn.

The walls are stiff panels on damped spring hinges, one at the foot and one halfway up: they give way to the hand, and the
camera sees it. The bag's bottom lies on a springy heap of paper whose height nobody sees. An arm this stiff does not notice
that it touches something so soft. In it lies
the key ring of the paper's robot, or one of the unseen objects of its table I.
"""

import itertools
from typing import Any

import mujoco
import numpy as np

from gym_playbyear.registry import check_option
from gym_playbyear.task import Prop
from gym_playbyear.tasks.arena import TABLE_TOP
from gym_playbyear.terminations import Termination

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


class Torn(Termination):
    """The hand pushed the bag's bottom or a wall so hard that it tears (the paper ends what damages the bag, too).

    Args:
        limit: Net force between hand and bag [N].
    """

    name = "torn"

    def __init__(self, limit: float):
        self.limit = limit

    def applies(self, env: Any) -> bool:
        return bool(env.contact_forces[f"gripper-{BAG}"] > self.limit)


CONTENTS = "contents"
# Light things between hard fingers: stiff, short contacts, and their own friction on whatever they touch (priority).
FRICTION = 0.5
_TOUCH = f'priority="2" condim="4" friction="{FRICTION} 0.005 0.0002" solref="0.005 1" solimp="0.95 0.99 0.0005"'
_STEEL, _BRASS = "0.75 0.77 0.80 1", "0.80 0.65 0.30 1"
_SOFT = 'priority="2" condim="4" friction="0.5 0.005 0.0002" solref="0.02 1" solimp="0.9 0.95 0.003"'
# What is round does not roll away: there are pills in the bottle, and the paper below gives way.
_ROUND = 'priority="2" condim="6" friction="0.5 0.005 0.002" solref="0.005 1" solimp="0.95 0.99 0.0005"'
_WHITE, _PENS = "0.95 0.95 0.95 1", ("0.15 0.25 0.75 1", "0.1 0.1 0.1 1", "0.7 0.15 0.15 1")
# Where each sits on the ring.
_HANG = {"lever": (1, 0, 0), "opener": (-1, 0, 0), "medallion": (0, 1, 0), "whistle": (0, -1, 0)}
_DROOP = (0.0, 0.6)  # rad: how far they hang down when the ring falls; a right angle is straight down
_RING_HEIGHT, _DROP_HEIGHT = 0.07, 0.045  # m
# How far what is too long for the fingers may be turned from lying across them [rad]; the rest lies as it likes.
_LARGEST_TURN = {"bottle": 0.5, "chips": 0.4, "pens": 0.4, "sponge": 0.2}
_RING_RADIUS, _WIRE = 0.008, 0.0013  # m


def _geom(kind: str, size, mass: float, rgba: str, where: str = "", touch: str = _TOUCH) -> str:
    sizes = " ".join(map(str, size))
    return f'<geom type="{kind}" size="{sizes}" mass="{mass}" {where} rgba="{rgba}" {touch}/>'


def _body(inside: str, name: str = CONTENTS, at: str = "0 0 0", joint: str | None = None) -> str:
    joint = joint or f'<freejoint name="{CONTENTS}"/>'
    return f'<body name="{name}" pos="{at}">{joint}{inside}</body>'


def _hanging(name: str, at: str, inside: str) -> str:
    """A thing that hangs on by a ball joint, with the friction of a link."""
    return _body(inside, name, at, f'<joint name="{name}" type="ball" damping="0.00003"/>')


def _keys() -> str:
    """A ring with a lever opener, a cap opener, a medallion and a whistle (the paper's, appendix A), about 0.08 kg."""
    d = 0.7071 * _RING_RADIUS * 1.3
    corners = [(d, d), (-d, d), (-d, -d), (d, -d), (d, d)]
    wire = "".join(
        _geom("capsule", (_WIRE,), 0.002, _STEEL, f'fromto="{a} {b} 0 {c} {e} 0"')
        for (a, b), (c, e) in itertools.pairwise(corners)
    )
    lever = _geom("box", (0.010, 0.005, 0.003), 0.020, _STEEL, 'pos="0.011 0 0"')
    opener = _geom("box", (0.008, 0.008, 0.003), 0.017, _STEEL, 'pos="-0.009 0 0"')
    medallion = _geom("cylinder", (0.008, 0.0025), 0.015, _BRASS, 'pos="0 0.009 0"')
    whistle = _geom("cylinder", (0.0065, 0.009), 0.020, _STEEL, 'pos="0 -0.010 0" euler="1.5708 0 0"')
    r = _RING_RADIUS
    hung = (
        _hanging("lever", f"{r} 0 0", lever)
        + _hanging("opener", f"{-r} 0 0", opener)
        + _hanging("medallion", f"0 {r} 0", medallion)
        + _hanging("whistle", f"0 {-r} 0", whistle)
    )
    return _body(wire + hung)


def _bottle() -> str:
    """A pill bottle of 0.04 kg, on its side."""
    lying = 'euler="0 1.5708 0"'
    cap = _geom("cylinder", (0.012, 0.006), 0.005, _WHITE, f'pos="0.029 0 0" {lying}', _ROUND)
    return _body(_geom("cylinder", (0.014, 0.024), 0.035, "0.95 0.6 0.2 1", lying, _ROUND) + cap)


def _chips() -> str:
    """A small bag of chips, thick in the middle, whose halves give way to each other."""

    def half(side: int) -> str:
        thick = _geom("box", (0.022, 0.007, 0.010), 0.007, "0.85 0.2 0.15 1", f'pos="0 {side * 0.007} 0"')
        return thick + _geom("box", (0.032, 0.008, 0.004), 0.004, "0.95 0.75 0.2 1", f'pos="0 {side * 0.008} 0"')

    hinge = '<joint name="fold" axis="1 0 0" stiffness="0.15" damping="0.002" range="-0.5 0.5"/>'
    return _body(half(1) + _body(half(-1), "other_half", joint=hinge))


def _pens() -> str:
    """Three pens in a rubber band."""
    pens = [_geom("capsule", (0.0045, 0.055), 0.009, colour, 'euler="0 1.5708 0"', _ROUND) for colour in _PENS]
    return _body(pens[0] + _hanging("pen_1", "0 0.0095 0.001", pens[1]) + _hanging("pen_2", "0 -0.0095 0.001", pens[2]))


def _candies() -> str:
    """Five wrapped sweets that hang together."""
    sweet = _geom("ellipsoid", (0.011, 0.009, 0.008), 0.006, "0.9 0.3 0.5 1")
    around = ("0.021 0.006 0", "-0.021 -0.006 0", "0.006 -0.019 0", "-0.006 0.019 0")
    return _body(sweet + "".join(_hanging(f"sweet_{k}", at, sweet) for k, at in enumerate(around)))


def _cloth() -> str:
    """A crumpled cloth: soft lumps that hang together."""
    lump = _geom("ellipsoid", (0.014, 0.011, 0.009), 0.006, "0.35 0.5 0.75 1", touch=_SOFT)
    around = ((0.010, 0.006, 0.004), (-0.010, 0.007, 0.002), (0.009, -0.008, 0.003), (-0.009, -0.007, 0.004))
    return _body(lump + "".join(_hanging(f"fold_{k}", " ".join(map(str, at)), lump) for k, at in enumerate(around)))


def _sponge() -> str:
    """A sponge of 6 x 4 x 3 cm."""
    return _body(_geom("box", (0.030, 0.020, 0.014), 0.012, "0.95 0.85 0.3 1", touch=_SOFT))


_MADE = {
    "keys": _keys,
    "bottle": _bottle,
    "chips": _chips,
    "pens": _pens,
    "candies": _candies,
    "cloth": _cloth,
    "sponge": _sponge,
}
CONTENTS_KINDS = tuple(_MADE)
# What crackles when it bends: the packet, and sweets in their wrappers. Joints, and factors on their speed.
_BENDS = {"chips": (("fold", 1.0),), "candies": tuple((f"sweet_{k}", 0.5) for k in range(4))}
_LOUDNESS = {"cloth": 0.05, "sponge": 0.05}  # of 1: nearly mute


def contents_prop(kind: str) -> Prop:
    """What is in the bag, by name; hidden and loose. Its material has the same name.

    Raises:
        OptionError: The name is not among `CONTENTS_KINDS`.
    """
    check_option("contents", kind, CONTENTS_KINDS)
    spec = _MADE[kind]()
    has_parts = spec.count("<body") > 1
    return Prop(
        CONTENTS, spec, kind, _LOUDNESS.get(kind, 1.0), True, True, jingles=has_parts, bends=_BENDS.get(kind, ())
    )


def drop(env: Any, place: np.ndarray, yaw: float, height: float, rng: np.random.Generator) -> None:
    """Lets the contents fall into the bag; a key ring with its keys hanging down.

    Args:
        env: The environment, at the beginning of an episode.
        place: (2,) above which point [m, world].
        yaw: Turn about the vertical in [-pi, pi] [rad]; what is longer than the fingers open turns less, in proportion.
        height: Of what they fall on [m, world].
        rng: How far the keys hang is drawn from it.
    """
    hanging = [name for name in _HANG if _has_joint(env.model, name)]
    yaw *= _LARGEST_TURN.get(_kind(env), np.pi) / np.pi
    env.set_pose(CONTENTS, (*place, height + (_RING_HEIGHT if hanging else _DROP_HEIGHT)), yaw)
    for name in hanging:
        axis, angle = np.cross(_HANG[name], (0, 0, -1)), rng.uniform(*_DROOP)
        address = env.model.joint(name).qposadr[0]
        env.data.qpos[address : address + 4] = (np.cos(angle / 2), *(np.sin(angle / 2) * axis))


def _kind(env: Any) -> str:
    """What is in the bag."""
    return next(str(prop.material) for prop in env.definition.props if prop.name == CONTENTS)


def _has_joint(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0


def middle_of(env: Any) -> np.ndarray:
    """Centre of mass of what is in the bag (3,) [m, world]."""
    model = env.model
    parts = model.body_rootid == model.body(CONTENTS).id
    return np.asarray(np.average(env.data.xipos[parts], axis=0, weights=model.body_mass[parts]))
