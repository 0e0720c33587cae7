#!/usr/bin/env bash
# Makes .venv with everything that development needs, at the versions of constraints.txt. Safe to run again.
# With LEROBOT=<checkout or wheel> it makes .venv-lerobot, which has that LeRobot, and all else at the same versions.
set -euo pipefail
lerobot=${LEROBOT:+$(realpath "$LEROBOT")}
cd "$(dirname "$0")/.."
venv=.venv${lerobot:+-lerobot}

fail() { echo "error: $*" >&2; exit 1; }

# A working Python of at least 3.12. One that is found on the PATH may still refuse to run (pyenv's shims do).
find_python() {
  local candidate
  for candidate in "${PYTHON:-}" python3.12 python3.13 python3 \
      "$HOME"/.pyenv/versions/3.1[2-9]*/bin/python3 /usr/local/bin/python3.1[2-9]; do
    [ -n "$candidate" ] || continue
    if "$candidate" -c 'import sys, venv; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1; then
      echo "$candidate"
      return
    fi
  done
  return 1
}

if ! $venv/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1; then
  python=$(find_python) || fail "no Python of at least 3.12 was found. Install one, or name it: make install PYTHON=/path/to/python3.12"
  echo "Making $venv with $("$python" --version)"
  rm -rf $venv
  "$python" -m venv $venv
fi

if uv --version >/dev/null 2>&1; then
  uv=uv
else
  [ -x $venv/bin/uv ] || $venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt uv
  uv=$venv/bin/uv
fi
export UV_LINK_MODE=${UV_LINK_MODE:-copy}  # hard links fail where the cache is on another file system
install() { VIRTUAL_ENV=$PWD/$venv "$uv" pip install --python $venv/bin/python "$@"; }
if [ -z "$lerobot" ]; then
  install --constraint constraints.txt --build-constraint constraints.txt -e . -e envs --group dev
else
  grep -v '^lerobot==' constraints.txt > $venv/constraints.txt
  echo "lerobot @ $lerobot" > $venv/lerobot.txt  # whatever version we ask for
  other=(--constraint $venv/constraints.txt --build-constraint $venv/constraints.txt --no-sources)
  install "${other[@]}" --reinstall-package lerobot "lerobot[training,evaluation,diffusion] @ $lerobot"
  install "${other[@]}" --override $venv/lerobot.txt -e . -e envs --group dev
fi

# Tests of microphones run a sound server, which hears files in place of a sound card. Without it they are skipped.
has_sound() { command -v pulseaudio && command -v pactl && $venv/bin/python -c 'import sounddevice' \
  && ls /usr/lib/*/alsa-lib/libasound_module_pcm_pulse.so; } >/dev/null 2>&1
if [ "$(uname -s)" = Linux ] && ! has_sound; then
  sound="pulseaudio pulseaudio-utils libportaudio2 libasound2-plugins"
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing a sound server for the tests of microphones"
    # shellcheck disable=SC2086
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive timeout 300 apt-get install -y -qq --no-install-recommends $sound; } \
      >/dev/null 2>&1 || true
  fi
  has_sound || echo "The tests of microphones through a sound server will be skipped. For them: sudo apt-get install $sound"
fi

# Rendering without a window needs EGL.
has_egl() { $venv/bin/python -c 'import ctypes; ctypes.CDLL("libEGL.so.1")' >/dev/null 2>&1; }
if [ "$(uname -s)" = Linux ] && ! has_egl; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing Mesa's EGL for rendering without a window"
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq libegl1 libgl1-mesa-dri
  fi
  has_egl || fail "libEGL is missing, which rendering needs. Install it (Debian, Ubuntu: sudo apt-get install libegl1 libgl1-mesa-dri) and try again."
fi
