#!/usr/bin/env bash
# Runs the accuracy harness over benchmark folders: the peers, and `rare refine`, from every set of starts.
#
#   run.sh DATA HARNESS OUT [peers|rare]
#
# DATA     folder of benchmark folders at any depth: cloud_bin_N.ply, pairs*.json, init_*.json
# HARNESS  the accuracy harness (a Python program)
# OUT      OUT/peers/FOLDER.PAIRS.START.json, OUT/rare/FOLDER.PAIRS.START.json; tables.py reads both. A file that is
#          there is not made again, and none is there before it is complete, so an interrupted run can be repeated.
#
# RARE (target/release/rare), PYTHON (python3) and RARE_OPTIONS (options of `rare refine`) may be set.
set -euo pipefail

if [ $# -lt 3 ] || [ $# -gt 4 ]; then
    echo "usage: run.sh DATA HARNESS OUT [peers|rare]" >&2
    exit 2
fi
data=$1 harness=$2 out=$3 which=${4:-both} here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
rare=${RARE:-target/release/rare} python=${PYTHON:-python3} options=${RARE_OPTIONS:-}
peers=init,p2p,p2l,tukey,multi,gicp,sgicp,svgicp

case $which in peers | rare | both) ;; *) echo "run.sh: $which is neither peers nor rare" >&2; exit 2 ;; esac
if [ "$which" != peers ] && [ ! -x "$rare" ]; then
    echo "run.sh: there is no program $rare: build it, or set RARE" >&2
    exit 2
fi
mkdir -p "$out/peers" "$out/rare"

# What the harness needs to know of scans that are not indoors.
scale_of() {
    case $1 in lidar* | street*) echo "--voxel 0.3 --scale 10 --success 5,0.6" ;; esac
}

# one RESULT FOLDER LIST STARTS METHODS...: a run of the harness, if there is no result yet.
one() {
    local result=$1 folder=$2 list=$3 starts=$4
    shift 4
    [ -s "$result" ] && return
    echo "$result" >&2
    # shellcheck disable=SC2046 # the words of scale_of are several arguments
    "$python" "$harness" "$folder" --pairs "$list" --init "$starts" $(scale_of "$(basename "$folder")") \
        "$@" --json "$result.part" >"$result.txt"
    mv "$result.part" "$result"
}

find -L "$data" -name 'pairs*.json' | sort | while read -r path; do
    folder=$(dirname "$path") list=$(basename "$path")
    for starts in "$folder"/init_*.json; do
        # The harness takes the identity for starts that are missing.
        "$python" "$here/covers.py" "$path" "$starts" || continue
        start=$(basename "$starts" .json)
        name=$(basename "$folder").${list%.json}.${start#init_}.json
        if [ "$which" != rare ]; then
            one "$out/peers/$name" "$folder" "$list" "$starts" --methods "$peers" </dev/null
        fi
        if [ "$which" != peers ]; then
            one "$out/rare/$name" "$folder" "$list" "$starts" --methods "" \
                --cmd "rare='$rare' refine {src} {ref} --init {init} --output {output} --json {json} $options" </dev/null
        fi
    done
done
