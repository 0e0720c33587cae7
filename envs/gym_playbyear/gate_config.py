"""The thresholds of `gym_playbyear.gates`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class GateConfig:
    """When the expert takes over. Lengths in metres, durations in control steps, shares of the episode's steps.

    Attributes:
        missed_height: The hand is this far above the table after it touched the cube, without it: it missed and moved on.
        search_share: From this share on, the same height without a touch counts as well.
        hover_share, hover_distance, hover_change: From this share on, open fingers this near the cube that hardly change the
            policy's action.
        still_steps, still_distance: The hand moved less than this in so many steps.
        shove_share, push_step: The cube was shoved by this share of what ends the attempt, and the policy goes on pushing by
            at least this much.
        grasp_reach, grasp_height: The cube is between the fingers when it is this near to their middle along the table, and
            their tips are this low.
        landed_steps: The hand touched the cube from above for so long.
        land_x, land_height, land_margin: Where coming down on the cube ends an attempt: the hand is about to when it is this
            near to the cube's middle across the line, and at most the margin, and one step, above where it lands.
        empty_opening: Fingers that were closed, and are this near to each other, hold nothing.
        release_reach: Fingers may open when the held cube is this near to the tray's middle.
        carry_past, carry_sink: A held cube that was carried is this far past the tray's middle, or so far below the height at
            which the expert carries and not over the tray: it is about to be put down beside it.
        far: From where it was lifted; a cube that is this far is carried back, to show the way to the tray anew.
        drop_distance: A cube that was held and is this far from the hand was dropped.
        stray_x, stray_y: How far a hand that searches on the table may be beside the line of the sweep, and before its start.
        hop_past: How far a hand that rose after the touch may go past the cube.
        memory_steps: How long the policy hears a touch; what it does then is judged by its result.
        search_step, travel_step: What the expert covers per step in the sweep and elsewhere, for what follows.
        grasp_steps, lift_steps, place_steps: What it needs from the touch until the fingers hold, to lift, and to release.
        slack_steps: It takes over when it has only so many steps more than it needs.
    """

    missed_height: float = 0.12
    search_share: float = 0.35
    hover_share: float = 0.8
    hover_distance: float = 0.05
    hover_change: float = 0.05
    still_steps: int = 24
    still_distance: float = 0.005
    shove_share: float = 0.3
    push_step: float = 0.003
    grasp_reach: float = 0.012
    grasp_height: float = 0.034
    landed_steps: int = 8
    land_x: float = 0.035
    land_height: float = 0.044
    land_margin: float = 0.012
    empty_opening: float = 0.03
    release_reach: float = 0.02
    carry_past: float = 0.03
    carry_sink: float = 0.015
    far: float = 0.1
    drop_distance: float = 0.04
    stray_x: float = 0.03
    stray_y: float = 0.12
    hop_past: float = 0.03
    memory_steps: int = 40
    search_step: float = 0.0085
    travel_step: float = 0.016
    grasp_steps: int = 25
    lift_steps: int = 5
    place_steps: int = 30
    slack_steps: int = 3
