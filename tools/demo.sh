#!/usr/bin/env bash
# The project at work on a bare machine: sets up, makes a small synthetic studio, checks it, calibrates its
# cameras from its pictures of a board, aligns its people, builds shards of them, trains a tiny prior for a
# minute, renders it, and shows it all.
# Every step prints the command that it runs. Run again, it resumes where it stopped. Prints the path of
# the page that shows the results last.
#   OUTPUT=DIR   where to put everything (default: demo_output)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash tools/setup.sh
bin=.venv/bin
studio=${OUTPUT:-demo_output}/studio
took=() # stage, seconds, stage, seconds ...

stage() { # stage NAME command...: prints and times the command
    local name=$1 start=$EPOCHREALTIME
    shift
    printf '\n== %s\n$%s\n' "$name" "$(printf ' %q' "$@")"
    "$@"
    took+=("$name" "$(awk "BEGIN { printf \"%.1f\", $EPOCHREALTIME - $start }")")
    printf '== %s took %s s\n' "$name" "${took[-1]}"
}

stage "synthetic studio" $bin/python tools/synthetic_studio --output "$studio" \
    --identities 4 --views 13 --resolution 256x384 --board.frames 14
stage inspection $bin/preface-inspect "$studio/capture"
stage calibration $bin/preface-calibrate board "$studio/capture" --output "$studio"
stage "inspection of the rigs" $bin/preface-inspect "$studio"/rigs/take??.json
stage alignment $bin/preface-align studio "$studio/capture" --rig "$studio" --output "$studio/alignment"
stage "inspection of the alignment" $bin/preface-inspect "$studio/alignment"
stage shards $bin/preface-build-shards "$studio/capture" --rig "$studio" --alignment "$studio/alignment" \
    --output "$studio/shards" --resolution 96x144 --holdout id0003
stage "inspection of the shards" $bin/preface-inspect "$studio/shards"
stage training $bin/preface-train "$studio/shards" --preset tiny --steps 300 --identities 3 --output "$studio/prior"
stage "inspection of the prior" $bin/preface-inspect "$studio/prior"
stage rendering $bin/preface-render "$studio/prior" --identity id0000 --orbit 6 --video --output "$studio/renders"
stage page $bin/python tools/show_studio.py "$studio" --took "${took[@]}"

here=$(cd "$studio" && pwd)
printf '\nReports, one per stage: %s\n' "$here"/rigs/take??.report.html "$here/alignment/report.html" \
    "$here/shards/masks.html" "$here/prior/validation" "$here/renders"
printf '\nOpen this page: %s\n' "$here/report.html"
