#!/usr/bin/env bash
# Installs the browser that the tests of playbyear-inspect's page run in, where that is possible without asking.
# Without it those tests are skipped, so this never fails.
set -uo pipefail

for name in chromium chromium-browser google-chrome google-chrome-stable; do
  command -v "$name" >/dev/null && exit 0
done

skip() { echo "Without Chromium the tests of the page are skipped: $*"; exit 0; }

[ "$(id -u)" = 0 ] && command -v apt-get >/dev/null || skip "install it (Debian, Ubuntu: sudo apt-get install chromium)"
echo "Installing Chromium for the tests of the page"
options=(-qq -o Acquire::Retries=1 -o Acquire::http::Timeout=20)
timeout 120 apt-get "${options[@]}" update \
  && DEBIAN_FRONTEND=noninteractive timeout 300 apt-get "${options[@]}" install -y --no-install-recommends chromium >/dev/null \
  || skip "it could not be installed"
