"""Any LeRobot robot with any number of microphones, as a Gymnasium environment: `--env.type=playbyear_robot`."""

import gymnasium as gym

ENV_ID = "playbyear_robot/Robot-v0"

if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point="lerobot_playbyear.robots.env:RobotEnv")
