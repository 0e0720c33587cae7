"""A person as expert: any LeRobot teleoperator, a window, and the keys that go with it (`--expert.type=teleop`).

Nothing is imported here, because the window's process imports this package, and it has to start in a second.
"""
