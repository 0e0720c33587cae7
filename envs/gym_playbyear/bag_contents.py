"""What can be in the bag: the key ring of the paper's robot, and the unseen objects of its table I."""

import itertools
from typing import Any

import mujoco
import numpy as np

from gym_playbyear.options import check_option
from gym_playbyear.task import Prop

CONTENTS = "contents"
# Light things between hard fingers: stiff, short contacts, and their own friction on whatever they touch (priority).
FRICTION = 0.5
_TOUCH = f'priority="2" condim="4" friction="{FRICTION} 0.005 0.0002" solref="0.005 1" solimp="0.95 0.99 0.0005"'
_STEEL, _BRASS = "0.75 0.77 0.80 1", "0.80 0.65 0.30 1"
_SOFT = 'priority="2" condim="4" friction="0.5 0.005 0.0002" solref="0.02 1" solimp="0.9 0.95 0.003"'
# What is round does not roll away: there are pills in the bottle, and the paper below gives way.
_ROUND = 'priority="2" condim="6" friction="0.5 0.005 0.002" solref="0.005 1" solimp="0.95 0.99 0.0005"'
_WHITE, _PENS = "0.95 0.95 0.95 1", ("0.15 0.25 0.75 1", "0.1 0.1 0.1 1", "0.7 0.15 0.15 1")
_HANG = {
    "lever": (1, 0, 0),
    "opener": (-1, 0, 0),
    "medallion": (0, 1, 0),
    "whistle": (0, -1, 0),
}  # where each sits on the ring
_DROOP = (0.0, 0.6)  # rad: how far they hang down when the ring falls; a right angle is straight down
_RING_HEIGHT, _DROP_HEIGHT = 0.07, 0.045  # m
# How far what is too long for the fingers may be turned from lying across them [rad]; the rest lies as it likes.
_LARGEST_TURN = {"bottle": 0.5, "chips": 0.4, "pens": 0.4, "sponge": 0.2}
_GRID = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 3)  # (P, 3)
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
_BENDS = {
    "chips": (("fold", 1.0),),
    "candies": tuple((f"sweet_{k}", 0.5) for k in range(4)),
}
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
    env.put(CONTENTS, (*place, height + (_RING_HEIGHT if hanging else _DROP_HEIGHT)), yaw)
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


def points_of(env: Any) -> np.ndarray:
    """Points spread through what is in the bag (N, 3) [m, world]."""
    model, data = env.model, env.data
    of_it = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body(CONTENTS).id)
    size = model.geom_size[of_it].copy()  # (G, 3)
    is_round = np.isin(model.geom_type[of_it], (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE))
    size[is_round] = size[is_round][:, [0, 0, 1]]
    size[model.geom_type[of_it] == mujoco.mjtGeom.mjGEOM_SPHERE] = size[:, [0, 0, 0]][
        model.geom_type[of_it] == mujoco.mjtGeom.mjGEOM_SPHERE
    ]
    local = size[:, None] * _GRID  # (G, P, 3)
    turned = np.einsum("gij,gpj->gpi", data.geom_xmat[of_it].reshape(-1, 3, 3), local)
    return (data.geom_xpos[of_it][:, None] + turned).reshape(-1, 3)
