#!/usr/bin/env bash
# One round of corrections on a robot with a microphone: correct, attach the sound, learn, act. Not tried on hardware.
# ROBOT names a file like so101.yaml with your robot, POLICY and DEMOS what was trained, and with what.
#   POLICY=outputs/train/checkpoints/last/pretrained_model DEMOS=outputs/demos_with_sound examples/corrections.sh outputs/round
set -euo pipefail
folder=${1:-outputs/round}
fps=${FPS:-20} task=${TASK:-Find the cube}
robot=--config_path=${ROBOT:-$(dirname "$0")/so101.yaml}

# LeRobot 0.6.1 uploads every fifth episode, whatever push_to_hub says, unless it is told otherwise.
# Space pauses, Tab begins and ends a correction, Space goes on, Esc ends.
lerobot-rollout --strategy.type=dagger --strategy.record_autonomous=true --policy.path="$POLICY" "$robot" \
  --strategy.upload_every_n_episodes=1000000 --play_sounds=false \
  --fps="$fps" --task="$task" --dataset.repo_id=me/rollout_corrections --dataset.no_stamp=true \
  --dataset.root="$folder/corrections" --dataset.push_to_hub=false --dataset.video=false --dataset.fps="$fps"

playbyear-attach-audio --dataset.repo_id=me/rollout_corrections --dataset.root="$folder/corrections"

playbyear-dagger --num_episodes=0 --steps="${STEPS:-1250}" --new_weights=true --batch_size=12 \
  --policy.path="$POLICY" --output_dir="$folder/dagger" \
  --dataset.repo_id=me/demos_with_sound --dataset.root="$DEMOS" \
  --interventions.repo_id=me/rollout_corrections_with_sound --interventions.root="$folder/corrections_with_sound"

lerobot-rollout --policy.path="$folder/dagger/checkpoints/last/pretrained_model" "$robot" --fps="$fps" --duration="${ACT_S:-60}"
