# The robot of corrections.sh: an SO-101 with its leader, a camera, and a contact microphone at the gripper. Not tried on hardware.
ROBOT=(
  --robot.type=so101_follower --robot.port=/dev/ttyACM0 --robot.id=follower
  "--robot.cameras={front: {type: opencv, index_or_path: 0, width: 640, height: 480, fps: 30}, gripper: {type: microphone, device: USB Audio}}"
)
TELEOP=(--teleop.type=so101_leader --teleop.port=/dev/ttyACM1 --teleop.id=leader)
