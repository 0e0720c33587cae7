#!/usr/bin/env bash
# From nothing to a policy that grasps what no camera shows: record, train, evaluate, film.
# `make demo` runs this in the right environment. DEMO_DIR, TASK, EPISODES, STEPS, EVAL_EPISODES change its size.
set -euo pipefail
cd "$(dirname "$0")/.."
export MUJOCO_GL=${MUJOCO_GL:-egl}

DEMO_DIR=${DEMO_DIR:-outputs/demo}
TASK=${TASK:-OccludedGrasp-v1}
EPISODES=${EPISODES:-50}
STEPS=${STEPS:-1250}
EVAL_EPISODES=${EVAL_EPISODES:-20}
EVAL_SEED=1000  # none of the recorded seeds, which count up from 0

dataset=$DEMO_DIR/dataset
train=$DEMO_DIR/train
checkpoint=$train/checkpoints/last/pretrained_model
commands=()

step() { printf '\n\033[1m== %s\033[0m\n' "$*"; }
run() { printf '$ %s\n' "$*"; commands+=("$*"); "$@"; }

step "1/5 Record $EPISODES demonstrations"
recorded=$(python -c 'import json, sys; print(json.load(open(sys.argv[1]))["total_episodes"])' "$dataset/meta/info.json" 2>/dev/null || echo 0)
if [ "$recorded" -ge "$EPISODES" ]; then
  echo "$dataset holds them."
else
  run playbyear-record --env.type=playbyear --env.task="$TASK" \
    --dataset.repo_id=demo/occluded --dataset.root="$dataset" --dataset.num_episodes=$((EPISODES - recorded)) --seed=0 --resume=true
fi

step "2/5 Train"
if [ -e "$checkpoint" ]; then
  echo "Using the policy in $checkpoint; remove $train to train again."
else
  rm -rf "$train"
  run playbyear-train --preset=cpu \
    --dataset.repo_id=demo/occluded --dataset.root="$dataset" --output_dir="$train" \
    --steps="$STEPS" --save_freq="$STEPS" --wandb.enable=false
fi

step "3/5 Evaluate on $EVAL_EPISODES seeds that it has not seen"
rm -f "$DEMO_DIR/eval/attempts.jsonl"  # to which evaluations append
run lerobot-eval --policy.path="$checkpoint" --env.type=playbyear --env.task="$TASK" \
  --eval.n_episodes="$EVAL_EPISODES" --eval.batch_size=10 --eval.use_async_envs=false \
  --env.attempts_file="$DEMO_DIR/eval/attempts.jsonl" --seed="$EVAL_SEED" --output_dir="$DEMO_DIR/eval"

step "4/5 What the best of those who cannot hear does on the same seeds"
run python -m gym_playbyear.check "$TASK" --seed="$EVAL_SEED" --episodes="$EVAL_EPISODES" --players expert blind --no-twin \
  --output="$DEMO_DIR/blind_floor.json" || [ $? = 1 ]  # 1: by chance more than a task promises of so few episodes

step "5/5 Film an episode with its sound"
run playbyear-video --policy.path="$checkpoint" --env.type=playbyear --env.task="$TASK" \
  --seed="$EVAL_SEED" --attempts="$EVAL_EPISODES" --output="$DEMO_DIR/rollout.mp4"

step "Result"
python - "$DEMO_DIR" <<'PY'
import json, sys
from pathlib import Path

folder = Path(sys.argv[1])
policy = json.loads((folder / "eval/eval_info.json").read_text())["overall"]
attempts = [json.loads(line) for line in (folder / "eval/attempts.jsonl").read_text().splitlines()]
attempts = sorted(attempts, key=lambda attempt: attempt["seed"])[: policy["n_episodes"]]
early = [attempt["acted_early"] for attempt in attempts if "acted_early" in attempt]
rows = json.loads((folder / "blind_floor.json").read_text())["rows"]
blind = {row["name"]: row["successes"] / row["n_episodes"] for row in rows}
expert = blind.pop("expert")
name, rate = max(blind.items(), key=lambda item: item[1])
if early:
    print(f"Acted before anything was heard, in:         {100 * sum(early) / len(early):.0f} %")
print(f"Success of the policy, {policy['n_episodes']} unseen seeds: {policy['pc_success']:.0f} %")
print(f"Success of the best blind script ({name}):     {100 * rate:.0f} %")
print(f"Success of the expert, who feels contact:    {100 * expert:.0f} %")
print(f"Film with sound: {(folder / 'rollout.mp4').resolve()}")
PY
printf '\nThe commands, to go on from here:\n'
printf '  %s\n' "${commands[@]}"
