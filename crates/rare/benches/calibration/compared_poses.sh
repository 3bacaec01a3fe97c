#!/usr/bin/env bash
# Dumps the poses that the refiner compares on the development data, for fit_ranking.py.
#
#   compared_poses.sh DATA OUT
#
# DATA     folder with redkitchen-dev/{frag50,frag20,scan1} and lidar-dev
# OUT      OUT/FOLDER.PAIRS.START.jsonl; a file that is there is not made again
#
# All pairs with low overlap of frag50 and frag20, every third of scan1's, and a third of the pairs with more overlap;
# the other two thirds of scan1 are not seen by these fits. The example must have been built:
# `cargo build --release --example compared_poses`.
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: compared_poses.sh DATA OUT" >&2
    exit 2
fi
data=$1 out=$2 program=${PROGRAM:-target/release/examples/compared_poses}
if [ ! -x "$program" ]; then
    echo "compared_poses.sh: there is no program $program: build it, or set PROGRAM" >&2
    exit 2
fi
mkdir -p "$out"

# dump FOLDER LIST EVERY STARTS...
dump() {
    local folder=$1 list=$2 every=$3 start
    shift 3
    for start in "$@"; do
        local result
        result=$out/$(basename "$folder").$list.$start.jsonl
        [ -s "$result" ] && continue
        "$program" "$data/$folder" "$list.json" "init_$start.json" "$every" 0 >"$result.part"
        mv "$result.part" "$result"
    done
}

dump redkitchen-dev/frag50 pairs_lo 1 cofinet5000 ransac kiss pert_medium pert_hard
dump redkitchen-dev/frag20 pairs_lo 1 ransac kiss pert_medium pert_hard
dump redkitchen-dev/scan1 pairs_lo 3 ransac kiss pert_medium pert_hard
dump redkitchen-dev/frag50 pairs 3 cofinet5000 ransac pert_hard
dump redkitchen-dev/frag20 pairs 3 ransac pert_hard
dump redkitchen-dev/scan1 pairs 6 kiss pert_hard
dump lidar-dev pairs 1 pert_easy pert_medium pert_hard
