#!/usr/bin/env bash
# The project at work on a bare machine: sets up, makes a small synthetic studio, checks it and shows it.
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
    --identities 4 --views 13 --resolution 256x384 --board.frames 4
stage inspection $bin/preface-inspect "$studio/capture"
stage page $bin/python tools/show_studio.py "$studio" --took "${took[@]}"

printf '\nOpen this page: %s\n' "$(cd "$studio" && pwd)/report.html"
