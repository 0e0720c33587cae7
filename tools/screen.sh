#!/usr/bin/env bash
# Installs what the tests of the window need, where that is possible without asking: a virtual screen, a program that
# presses keys on it, and pynput, with which LeRobot's keyboard_ee hears them.
# Without the first two those tests are skipped, without pynput one of them; so this never fails.
set -uo pipefail
cd "$(dirname "$0")/.."

has_pynput() { .venv/bin/python -c 'import importlib.util as u, sys; sys.exit(u.find_spec("pynput") is None)'; }
if ! has_pynput; then
  echo "Installing pynput for the test of LeRobot's keyboard"
  uv=$(command -v uv || echo .venv/bin/uv)
  UV_LINK_MODE=${UV_LINK_MODE:-copy} VIRTUAL_ENV=$PWD/.venv timeout 300 "$uv" pip install --quiet \
    --python .venv/bin/python --constraint constraints.txt pynput \
    || echo "Without pynput the test of LeRobot's keyboard is skipped: it could not be installed (it needs a C compiler)"
fi

command -v Xvfb >/dev/null && command -v xdotool >/dev/null && exit 0
skip() { echo "Without Xvfb and xdotool the tests of the window are skipped: $*"; exit 0; }

[ "$(id -u)" = 0 ] && command -v apt-get >/dev/null || skip "install them (Debian, Ubuntu: sudo apt-get install xvfb xdotool)"
echo "Installing Xvfb and xdotool for the tests of the window"
options=(-qq -o Acquire::Retries=1 -o Acquire::http::Timeout=20)
timeout 120 apt-get "${options[@]}" update \
  && DEBIAN_FRONTEND=noninteractive timeout 300 apt-get "${options[@]}" install -y --no-install-recommends xvfb xdotool >/dev/null \
  || skip "they could not be installed"
