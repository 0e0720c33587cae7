"""The job script for Slurm, run by bash with stand-ins for a cluster's programs; no cluster was at hand."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from accelerate.commands.launch import launch_command_parser

from lerobot_playbyear.scripts.command import OPTIONS_FILE, find_mistake
from lerobot_playbyear.training.presets import apply_preset

SCRIPT = Path(__file__).parents[1] / "examples" / "slurm" / "train.sbatch"
N_NODES, N_GPUS, N_CORES = 2, 4, 32

STAND_INS = {
    "scontrol": 'printf "node-a\\nnode-b\\n"',
    "srun": f'for node in $(seq 0 {N_NODES - 1}); do SLURM_NODEID=$node "$@"; done',
    "accelerate": f"{sys.executable} -c 'import json, os, sys; "
    'print(json.dumps([os.environ["OMP_NUM_THREADS"], *sys.argv[1:]]))\' "$@"',
    "playbyear-train": "exit 1",
}


@pytest.fixture
def submit(tmp_path):
    """Runs the script as `sbatch` would on each node; the command lines of `accelerate`."""
    for name, text in STAND_INS.items():
        program = tmp_path / name
        program.write_text(f"#!/bin/bash\n{text}\n")
        program.chmod(0o755)
    slurm = {
        "SLURM_JOB_NAME": "playbyear",
        "SLURM_JOB_ID": "7",
        "SLURM_JOB_NODELIST": "node-[a-b]",
        "SLURM_NNODES": str(N_NODES),
        "SLURM_GPUS_ON_NODE": str(N_GPUS),
        "SLURM_CPUS_PER_TASK": str(N_CORES),
    }

    def run(*options, **variables):
        environment = {**os.environ, **slurm, **variables, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        result = subprocess.run(["bash", str(SCRIPT), *options], capture_output=True, text=True, env=environment)
        return result, [json.loads(line) for line in result.stdout.splitlines()]

    return run


def test_every_node_starts_a_process_for_each_of_its_gpus(submit, tmp_path):
    result, lines = submit("--steps=10", DATASET="me/demos", ROOT="/shared/demos")
    assert result.returncode == 0, result.stderr
    assert len(lines) == N_NODES
    for rank, (threads, launch, *arguments) in enumerate(lines):
        assert (threads, launch) == (str(N_CORES // N_GPUS), "launch")
        options = launch_command_parser().parse_args(arguments)
        assert (options.multi_gpu, options.num_machines, options.num_processes) == (True, N_NODES, N_NODES * N_GPUS)
        assert (options.machine_rank, options.main_process_ip, options.main_process_port) == (rank, "node-a", 29500)
        assert options.training_script == str(tmp_path / "playbyear-train")


def test_the_options_are_those_of_the_command(submit):
    _, lines = submit("--steps=10", DATASET="me/demos", ROOT="/shared/demos")
    training = launch_command_parser().parse_args(lines[0][2:]).training_script_args
    listed = json.loads(OPTIONS_FILE.read_text())
    assert find_mistake(training, listed["playbyear-train"], listed["policies"]) is None
    assert find_mistake(apply_preset(training), listed["playbyear-train"], listed["policies"]) is None
    assert {"--preset=gpu", "--dataset.repo_id=me/demos", "--dataset.root=/shared/demos", "--store=disk"} <= set(
        training
    )
    assert training[-1] == "--steps=10"
    assert "--output_dir=outputs/playbyear-7" in training


def test_a_job_without_a_dataset_says_so(submit):
    result, _ = submit()
    assert result.returncode != 0
    assert "DATASET: name of the dataset" in result.stderr


def test_what_sbatch_reads_asks_for_what_the_script_uses():
    wanted = dict(
        line.split("#")[1].removeprefix("SBATCH --").strip().split("=", 1)
        for line in SCRIPT.read_text().splitlines()
        if line.startswith("#SBATCH")
    )
    assert {"nodes", "gpus-per-node", "cpus-per-task", "time"} <= wanted.keys()
    assert wanted["ntasks-per-node"] == "1", "one launcher per node"
