"""What can be in the bag: the key ring of the paper's robot, and the unseen objects of its table I."""

from typing import Any

import numpy as np

from gym_playbyear.task import Prop

CONTENTS = "contents"
# Light things between hard fingers: stiff, short contacts, and their own friction on whatever they touch (priority).
_TOUCH = 'priority="2" condim="4" friction="0.5 0.005 0.0002" solref="0.005 1" solimp="0.95 0.99 0.0005"'
_STEEL, _BRASS = "0.75 0.77 0.80 1", "0.80 0.65 0.30 1"
_RING_RADIUS, _WIRE = 0.010, 0.0015  # m


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
    """A ring with a lever opener, a cap opener, a medallion and a whistle (the paper's, appendix A), about 0.1 kg."""
    d = 0.7071 * _RING_RADIUS * 1.3
    corners = [(d, d), (-d, d), (-d, -d), (d, -d), (d, d)]
    wire = "".join(
        _geom("capsule", (_WIRE,), 0.002, _STEEL, f'fromto="{a} {b} 0 {c} {e} 0"')
        for (a, b), (c, e) in zip(corners, corners[1:], strict=False)
    )
    lever = _geom("box", (0.030, 0.007, 0.0025), 0.025, _STEEL, 'pos="0.034 0 0"')
    opener = _geom("box", (0.019, 0.014, 0.0025), 0.020, _STEEL, 'pos="-0.023 0 0"')
    medallion = _geom("cylinder", (0.016, 0.002), 0.020, _BRASS, 'pos="0 0.020 0"')
    whistle = _geom("cylinder", (0.009, 0.019), 0.025, _STEEL, 'pos="0 -0.024 0" euler="1.5708 0 0"')
    r = _RING_RADIUS
    hung = (
        _hanging("lever", f"{r} 0 0", lever)
        + _hanging("opener", f"{-r} 0 0", opener)
        + _hanging("medallion", f"0 {r} 0", medallion)
        + _hanging("whistle", f"0 {-r} 0", whistle)
    )
    return _body(wire + hung)


def contents_prop(name: str) -> Prop:
    return Prop(CONTENTS, _keys(), material="keys", loose=True, hidden=True, jingles=True)


def middle_of(env: Any) -> np.ndarray:
    """Centre of mass of what is in the bag (3,) [m, world]."""
    model = env.model
    parts = model.body_rootid == model.body(CONTENTS).id
    return np.asarray(np.average(env.data.xipos[parts], axis=0, weights=model.body_mass[parts]))
