#!/usr/bin/env bash
# Installs what some tests need, where that is possible without asking: the browser that playbyear-inspect's page runs in; for
# the window a virtual screen and a program that presses keys on it. Without them those tests are skipped; so this never fails.
set -uo pipefail
cd "$(dirname "$0")/.."

has() { command -v "$1" >/dev/null; }

# Programs, and whose tests are skipped without them.
install_for() {
  local without="Without $1 the tests of $2 are skipped:"
  if [ "$(id -u)" != 0 ] || ! has apt-get; then
    echo "$without install what is missing (Debian, Ubuntu: sudo apt-get install ${*:3})"
    return
  fi
  echo "Installing $1 for the tests of $2"
  local options=(-qq -o Acquire::Retries=1 -o Acquire::http::Timeout=20)
  timeout 120 apt-get "${options[@]}" update \
    && DEBIAN_FRONTEND=noninteractive timeout 300 apt-get "${options[@]}" install -y --no-install-recommends "${@:3}" >/dev/null \
    || echo "$without it could not be installed"
}

has chromium || has chromium-browser || has google-chrome || has google-chrome-stable \
  || install_for Chromium "the page" chromium
{ has Xvfb && has xdotool; } || install_for "Xvfb and xdotool" "the window" xvfb xdotool
exit 0
