#!/usr/bin/env bash
# The main job on a bare machine, from nothing: sets up, makes a small synthetic studio, calibrates its cameras from
# pictures of a board, aligns its people, builds shards of them, trains a tiny prior on all but one of them, fits the
# one that it has not seen from two photographs, with the prior and without, renders the head from side to side,
# measures it on the photographs that were kept away and its surface against the studio's. Then it fits the same person
# from the prior that comes with preface, which has seen more people, and shows all of it on one page. About ten
# minutes on two cores, and five for the set-up the first time. Every stage prints the command that it runs. Run again,
# it resumes where it stopped; delete OUTPUT to begin anew.
# Prints the path of the page last.
#   --pretrained  start from the prior that comes with preface and train none: one new person is photographed, aligned
#                 on the prior's template and fitted
#   OUTPUT=DIR    where to put everything (default: demo_output, or demo_output_pretrained)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

pretrained=false
for word in "$@"; do
    case $word in
        --pretrained) pretrained=true ;;
        *)
            printf "demo.sh: '%s' is not known; usage: [OUTPUT=DIR] bash tools/demo.sh [--pretrained]\n" "$word" >&2
            exit 2
            ;;
    esac
done

bash tools/setup.sh
bin=.venv/bin
# Minutes that each stage takes on two cores, for the estimate of what is left.
if $pretrained; then
    out=${OUTPUT:-demo_output_pretrained}
    prior=pretrained
    # Another seed than that of the studio which the prior was trained in: somebody new.
    studio=(--identities 1 --takes 1 --seed 2024)
    fitted=id0000
    minutes=(0.5 0.1 0.1 0.3 0.2 0.1 1.5 1.2 0.5 1.0 0.5 0.1)
else
    out=${OUTPUT:-demo_output}
    prior=$out/prior
    people=13
    studio=(--identities "$people")
    fitted=$(printf 'id%04d' $((people - 1))) # the last of them
    minutes=(2.0 0.0 0.7 0.6 0.5 1.4 0.5 0.5 0.3 0.8 0.4 0.1 0.1 0.6 0.3 0.5 0.3 0.1)
fi
views=(cam04 cam05)
surfaces=(cam00 cam02 cam07) # in front, to the side and from above; not fitted to
quality=draft
# Without a prior there is nothing to invert: the same number of steps, inversion's among them, all finetune.
steps=$($bin/python -c 'import sys; from preface.model.fitting.configuration import defaults
inversion, finetuning, _ = defaults(sys.argv[1])
print(inversion.steps + finetuning.steps)' "$quality")
mkdir -p "$out"
number=0

stage() { # stage NAME command...: says what is left, prints, times and notes down the command
    local name=$1 start=$EPOCHREALTIME took left words
    shift
    words=$(printf '%q ' "${@#$bin/}")
    left=$(printf '%s\n' "${minutes[@]:number}" | awk '{ s += $1 } END { printf "%.0f", s }')
    number=$((number + 1))
    printf '\n== %d of %d: %s, about %s minutes to the end\n$%s\n' \
        "$number" "${#minutes[@]}" "$name" "$left" "$(printf ' %q' "$@")"
    # Not again what is done: a new calibration differs in its last bits, and all that follows would be of another rig.
    if [[ -f $out/stages.tsv ]] &&
        STAGE=$name WORDS=$words awk -F'\t' '$1 == ENVIRON["STAGE"] && $3 == ENVIRON["WORDS"] { done = 1 }
            END { exit !done }' "$out/stages.tsv"; then
        echo "== $name was done before"
        return
    fi
    "$@"
    took=$(awk "BEGIN { printf \"%.1f\", $EPOCHREALTIME - $start }")
    printf '%s\t%s\t%s\n' "$name" "$took" "$words" >> "$out/stages.tsv"
    printf '== %s took %s s\n' "$name" "$took"
}

if $pretrained; then
    size=$($bin/python -c 'import sys; from preface.model.training.prior_files import read_prior
print("{}x{}".format(*read_prior(sys.argv[1]).scene.resolution))' "$prior")
    onto=(--template "$prior")
    holdout=()
else
    size=96x144
    onto=()
    holdout=(--holdout "$fitted")
fi
stage "synthetic studio" $bin/python tools/synthetic_studio --output "$out" \
    "${studio[@]}" --views 13 --resolution 256x384 --board.frames 14
if $pretrained; then
    stage "prior" $bin/preface-inspect "$prior"
fi
stage "inspection" $bin/preface-inspect "$out/capture"
stage "calibration" $bin/preface-calibrate board "$out/capture" --output "$out"
stage "alignment" $bin/preface-align studio "$out/capture" --rig "$out" "${onto[@]}" --output "$out/alignment"
stage "shards" $bin/preface-build-shards "$out/capture" --rig "$out" --alignment "$out/alignment" \
    --output "$out/shards" --resolution "$size" "${holdout[@]}"
if ! $pretrained; then
    stage "prior" $bin/preface-train "$out/shards" --preset tiny --identities $((people - 1)) --output "$prior"
fi
stage "fit" $bin/preface-fit "$out/shards" --prior "$prior" --identity "$fitted" --views "${views[@]}" \
    --quality "$quality" --output "$out/head"
stage "fit without a prior" $bin/preface-fit "$out/shards" --prior none --like "$prior" --identity "$fitted" \
    --views "${views[@]}" --quality "$quality" --finetuning.steps "$steps" --output "$out/head-without-prior"
stage "orbit" $bin/preface-render "$out/head" --orbit 24 --video --no-exr --output "$out/renders"
stage "evaluation" $bin/preface-evaluate "$out/head" "$out/head-without-prior" --shards "$out/shards" --images \
    --output "$out/evaluation"
stage "geometry" $bin/python tools/bench/head_truth.py "$out/head" "$out/head-without-prior" --shards "$out/shards" \
    --studio "$out" --views "${surfaces[@]}" --pictures "$out/geometry" --json "$out/geometry.json"
if ! $pretrained; then
    # What more people give: the same person, placed on the template of the prior that comes with preface.
    box="the prior in the box"
    stage "alignment, $box" $bin/preface-align studio "$out/capture" --rig "$out" --only "$fitted" \
        --template pretrained --landmarks "$out/alignment/landmarks" --output "$out/alignment-pretrained"
    stage "shards, $box" $bin/preface-build-shards "$out/capture" --rig "$out" \
        --alignment "$out/alignment-pretrained" --only "$fitted" --resolution "$size" --output "$out/shards-pretrained"
    stage "fit, $box" $bin/preface-fit "$out/shards-pretrained" --prior pretrained --identity "$fitted" \
        --views "${views[@]}" --quality "$quality" --output "$out/head-pretrained"
    stage "orbit, $box" $bin/preface-render "$out/head-pretrained" --orbit 24 --video --no-exr \
        --output "$out/renders-pretrained"
    stage "evaluation, $box" $bin/preface-evaluate "$out/head-pretrained" --shards "$out/shards-pretrained" --images \
        --output "$out/evaluation-pretrained"
    stage "geometry, $box" $bin/python tools/bench/head_truth.py "$out/head-pretrained" \
        --shards "$out/shards-pretrained" --studio "$out" --views "${surfaces[@]}" --pictures "$out/geometry" \
        --json "$out/geometry-pretrained.json"
fi
stage "page of the studio" $bin/python tools/show_studio.py "$out" --page studio.html
$bin/python tools/show_demo.py "$out"

here=$(cd "$out" && pwd)
printf '\nOpen this page: %s\n' "$here/report.html"
