"""Manipulation tasks in which the target is hidden from every camera and only contact sound reveals it."""

from gymnasium.envs.registration import register

__version__ = "0.1.0"

TASKS = ("OccludedGrasp-v0", "OccludedPickPlace-v0")

register("gym_playbyear/OccludedGrasp-v0", "gym_playbyear.occluded_grasp:OccludedGraspEnv")
register("gym_playbyear/OccludedPickPlace-v0", "gym_playbyear.occluded_pick_place:OccludedPickPlaceEnv")
