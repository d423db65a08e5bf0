#!/usr/bin/env bash
# Installs what tests need beyond Python packages, on Debian and Ubuntu: a real one-node Slurm and a
# browser. Without them the tests marked `slurm` and those of the viewer's page skip.
set -euo pipefail
root=()
[ "$(id -u)" = 0 ] || root=(sudo)
"${root[@]}" apt-get update -q
"${root[@]}" env DEBIAN_FRONTEND=noninteractive \
  apt-get install -q -y --no-install-recommends slurm-wlm munge chromium
