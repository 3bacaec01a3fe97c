#!/usr/bin/env bash
# Evaluates the refiner with each of its parts switched off, for ablation.py.
#
#   ablation.sh OUT FOLDER...
#
# OUT      OUT/VARIANT/FOLDER.PAIRS.START: the results; what was begun goes on where it was interrupted
# FOLDER   benchmark folders: cloud_bin_N.ply, pairs*.json, init_*.json
#
# RARE (target/release/rare) and PYTHON (python3) may be set.
set -euo pipefail

if [ $# -lt 2 ]; then
    echo "usage: ablation.sh OUT FOLDER..." >&2
    exit 2
fi
out=$1 here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
shift
rare=${RARE:-target/release/rare} python=${PYTHON:-python3}
if [ ! -x "$rare" ]; then
    echo "ablation.sh: there is no program $rare: build it, or set RARE" >&2
    exit 2
fi

# variant NAME OPTIONS...: all folders, lists and starts.
variant() {
    local name=$1 folder list starts
    shift
    for folder in "${folders[@]}"; do
        for list in "$folder"/pairs*.json; do
            for starts in "$folder"/init_*.json; do
                "$python" "$here/covers.py" "$list" "$starts" || continue
                local result
                result=$out/$name/$(basename "$folder").$(basename "$list" .json).$(basename "$starts" .json)
                mkdir -p "$(dirname "$result")"
                "$rare" eval folder "$folder" --pairs "$(basename "$list")" --init "$starts" --methods init,refine \
                    "$@" --output "$result" >/dev/null </dev/null
            done
        done
    done
}

folders=("$@")
variant everything
variant no-search --no-search
variant no-verify --no-verify
variant no-polish --no-polish
variant one-round --rounds 1
variant features-alone --no-search --no-verify --no-polish
