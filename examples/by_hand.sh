#!/usr/bin/env bash
# The main job with LeRobot's own commands, small enough to watch: two demonstrations, four updates, two seconds of acting.
# Enough to see that everything works, far too little to learn; `make demo` is the real thing.
set -euo pipefail
export MUJOCO_GL=${MUJOCO_GL:-egl}
folder=${1:-outputs/by_hand}

playbyear-record --env.type=playbyear --env.task=OccludedGrasp-v1 \
  --dataset.repo_id=me/occluded --dataset.root="$folder/dataset" --dataset.num_episodes=2 --seed=0

lerobot-train --policy.type=playbyear --policy.push_to_hub=false --policy.device=cpu \
  --policy.image_size=48 --policy.vision_width=8 \
  --dataset.repo_id=me/occluded --dataset.root="$folder/dataset" --dataset.video_backend=pyav \
  --batch_size=4 --steps=4 --num_workers=0 --output_dir="$folder/train"

lerobot-eval --policy.path="$folder/train/checkpoints/last/pretrained_model" \
  --env.type=playbyear --env.task=OccludedGrasp-v1 --env.episode_length=40 --eval.n_episodes=1 --eval.batch_size=1 --output_dir="$folder/eval"
