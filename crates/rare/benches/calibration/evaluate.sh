#!/usr/bin/env bash
# Evaluates the refiner on everything that the confidence is fitted to, for fit.py.
#
#   evaluate.sh DATA OUT
#
# DATA     folder with benchmark folders at any depth (cloud_bin_N.ply, pairs*.json, init_*.json), among them
#          redkitchen-dev/frag50, redkitchen-dev/scan1 and lidar-dev, and with pairs/regtr_hotel_um_8_15.npz
# OUT      OUT/scenes: simulated benchmarks and scans of different places; OUT/results/FOLDER.PAIRS.START: the results;
#          OUT/objects: those of objects, which have a model of their own. What was begun goes on where it was interrupted.
#
# RARE (target/release/rare), SIMULATE (target/release/examples/synthetic_benchmark) and PYTHON (python3) may be set.
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: evaluate.sh DATA OUT" >&2
    exit 2
fi
data=$1 out=$2 here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
rare=${RARE:-target/release/rare} simulate=${SIMULATE:-target/release/examples/synthetic_benchmark} python=${PYTHON:-python3}
for program in "$rare" "$simulate"; do
    if [ ! -x "$program" ]; then
        echo "evaluate.sh: there is no program $program: build it, or set RARE and SIMULATE" >&2
        exit 2
    fi
done
mkdir -p "$out/scenes" "$out/results" "$out/objects"

# evaluate WHERE FOLDER LIST STARTS OPTIONS...: results of one set of starts.
evaluate() {
    local where=$1 folder=$2 list=$3 starts=$4
    shift 4
    "$rare" eval folder "$folder" --pairs "$list.json" --init "$starts" --methods refine --jobs "$(nproc)" "$@" \
        --output "$out/$where/$(basename "$folder").$list.$(basename "$starts" .json)" >/dev/null </dev/null
}

find -L "$data" -name 'pairs*.json' | sort | while read -r path; do
    for starts in "$(dirname "$path")"/init_*.json; do
        "$python" "$here/../accuracy/covers.py" "$path" "$starts" || continue
        evaluate results "$(dirname "$path")" "$(basename "$path" .json)" "$starts"
    done
done

# Simulated scans, and scans of which nothing belongs together: of real and simulated rooms, and of other simulated ones.
scenes=$out/scenes
for of in "rooms 12 1" "objects 10 2" "streets 6 3"; do
    read -r kind count seed <<<"$of"
    [ -d "$scenes/$kind" ] || "$simulate" "$kind" "$count" "$seed" "$scenes/$kind"
done
cloud() { echo "$scenes/$1/cloud_bin_$2.ply"; }
[ -d "$scenes/different-rooms" ] || "$python" "$here/different_places.py" "$scenes/different-rooms" \
    "kitchen=$data/redkitchen-dev/frag50/cloud_bin_1.ply,$data/redkitchen-dev/frag50/cloud_bin_4.ply,$data/redkitchen-dev/scan1/cloud_bin_2.ply" \
    "hotel=$data/pairs/regtr_hotel_um_8_15.npz" \
    "a=$(cloud rooms 0),$(cloud rooms 1)" "b=$(cloud rooms 2),$(cloud rooms 3)" "c=$(cloud rooms 4),$(cloud rooms 5)"
[ -d "$scenes/different-simulated" ] || "$python" "$here/different_places.py" "$scenes/different-simulated" \
    "d=$(cloud rooms 12),$(cloud rooms 13)" "e=$(cloud rooms 14),$(cloud rooms 15)" "f=$(cloud rooms 16)"
[ -d "$scenes/different-streets" ] || "$python" "$here/different_places.py" "$scenes/different-streets" \
    "a=$(cloud streets 0),$(cloud streets 1)" "b=$(cloud streets 2),$(cloud streets 3)" "c=$(cloud streets 4)"
[ -d "$scenes/different-objects" ] || "$python" "$here/different_places.py" "$scenes/different-objects" \
    "a=$(cloud objects 0),$(cloud objects 1)" "b=$(cloud objects 2),$(cloud objects 3)" "c=$(cloud objects 4)"
for folder in "$scenes"/*; do
    # No sensor stood at the origin of an object's scan.
    case $folder in
        *objects) where=objects options=(--profile object) ;;
        *) where=results options=() ;;
    esac
    for starts in "$folder"/init_*.json; do
        evaluate "$where" "$folder" pairs "$starts" "${options[@]}"
    done
done
