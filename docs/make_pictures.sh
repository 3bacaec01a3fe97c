#!/usr/bin/env bash
# Makes the README's pictures from `rare demo`: its report as a browser shows it, from the top and one of its views.
#
#   cargo build --release && docs/make_pictures.sh
#
# Needs Chromium, Node.js and npm.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
tests=$root/crates/rare-cli/tests/browser
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cd "$scratch"
"$root/target/release/rare" demo --report demo.html
[ -d "$tests/node_modules" ] || (cd "$tests" && npm ci --no-audit --no-fund)
node "$tests/reports.mjs" --screenshots screenshots demo.html
cp screenshots/demo-top.png "$root/docs/report.png"
cp screenshots/demo-view.png "$root/docs/view.png"
