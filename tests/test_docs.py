"""What the pages say is there: commands, links, films, and the script for clusters, which bash runs with stand-ins."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from accelerate.commands.launch import launch_command_parser

from lerobot_playbyear.scripts.command import OPTIONS_FILE, find_mistake
from lerobot_playbyear.training.command_line import apply_preset

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
LISTED = json.loads(OPTIONS_FILE.read_text())
FILMS = sorted(path.name for path in (ROOT / "docs/media/listen").glob("*.mp4"))


def named(page: Path) -> list[list[str]]:
    """The commands of this package in a page's blocks of code."""
    text = page.read_text().replace("\\\n", " ")
    blocks = re.findall(r"(?<=\n\n)(?:    .*\n)+|^```\w*\n(?:.*\n)*?```", text, re.MULTILINE)
    lines = [line.strip() for block in blocks for line in block.splitlines() if not line.endswith(".")]
    lines = [line.partition(" > ")[0] for line in lines if re.match(r"playbyear-[a-z-]+ -", line)]
    return [shlex.split(re.sub(r"--json\b", "--json=true", line), comments=True) for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_the_options_in_a_pages_commands_exist(page):
    for command, *options in named(page):
        if options == ["--help"]:
            continue
        listed = {**LISTED[command], "required": []} if "..." in options else LISTED[command]
        given = [option for option in options if option != "..."]
        if command == "playbyear-train":
            given = apply_preset([option.replace("--store=", "--store.place=") for option in given])
        assert find_mistake(given, listed, LISTED["policies"]) is None, " ".join([command, *options])


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_a_pages_links_lead_to_what_is_there(page):
    for link, _, anchor in (found.partition("#") for found in re.findall(r"\]\(([^)\s]+)", page.read_text())):
        if "://" in link:
            continue
        target = page.parent / link if link else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), f"{link}#{anchor}"


def anchors(page: Path) -> list[str]:
    """The headings of a page, as GitHub makes anchors of them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    titles = [re.sub(r"\[(.*?)\]\(.*?\)", r"\1", title) for title in re.findall(r"^#+ (.+?) *$", text, re.MULTILINE)]
    slugs = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
    return [f"{slug}-{slugs[:i].count(slug)}" if slug in slugs[:i] else slug for i, slug in enumerate(slugs)]


def test_the_guide_to_listening_names_the_films_that_are_there():
    assert len(FILMS) == 6
    assert sorted(re.findall(r"src='([^']+)'", (ROOT / "docs/media/listen/index.html").read_text())) == FILMS
    assert sorted(set(re.findall(r"media/listen/(\w+\.mp4)", (ROOT / "docs/listen.md").read_text()))) == FILMS


@pytest.mark.parametrize("name", [*(f"listen/{name}" for name in FILMS), "noise/kinds.mp4"])
def test_a_film_is_small_and_is_heard(name):
    path = ROOT / "docs/media" / name
    assert path.stat().st_size < 320_000
    with av.open(str(path)) as film:
        assert {stream.codec_context.name for stream in film.streams} == {"h264", "aac"}
        sound = np.concatenate([frame.to_ndarray().ravel() for frame in film.decode(audio=0)])
    assert np.abs(sound).max() > 0.4


def test_on_a_cluster_every_node_starts_a_process_for_each_of_its_gpus(tmp_path):
    """The job script for Slurm; no cluster was at hand."""
    tell = 'import json, os, sys; print(json.dumps([os.environ["OMP_NUM_THREADS"], *sys.argv[1:]]))'
    stand_ins = {
        "scontrol": 'printf "node-a\\nnode-b\\n"',
        "srun": 'for node in 0 1; do SLURM_NODEID=$node "$@"; done',
        "accelerate": f"{sys.executable} -c '{tell}' \"$@\"",
        "playbyear-train": "exit 1",
    }
    for name, text in stand_ins.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    slurm = {"SLURM_JOB_NAME": "playbyear", "SLURM_JOB_ID": "7", "SLURM_JOB_NODELIST": "node-[a-b]"}
    slurm |= {"SLURM_NNODES": "2", "SLURM_GPUS_ON_NODE": "4", "SLURM_CPUS_PER_TASK": "32"}
    environment = {**os.environ, **slurm, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    script = ["bash", str(ROOT / "examples/slurm/train.sbatch"), "--steps=10"]
    refused = subprocess.run(script, capture_output=True, text=True, env=environment, check=False)
    assert "DATASET: name of the dataset" in refused.stderr
    data = {"DATASET": "me/demos", "ROOT": "/shared/demos"}
    result = subprocess.run(script, capture_output=True, text=True, env={**environment, **data}, check=True)
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(lines) == 2
    for rank, (threads, launch, *arguments) in enumerate(lines):
        assert (threads, launch) == ("8", "launch")
        options = launch_command_parser().parse_args(arguments)
        assert (options.multi_gpu, options.num_machines, options.num_processes) == (True, 2, 8)
        assert (options.machine_rank, options.main_process_ip, options.main_process_port) == (rank, "node-a", 29500)
        training = options.training_script_args
        assert find_mistake(training, LISTED["playbyear-train"], LISTED["policies"]) is None
        data_of_it = {"--preset=gpu", "--dataset.repo_id=me/demos", "--dataset.root=/shared/demos", "--store=disk"}
        assert data_of_it | {"--output_dir=outputs/playbyear-7", "--steps=10"} <= set(training)
