#!/bin/sh
# sh bench/results.sh [--quick] FOLDER PROGRAM...
# Runs the programs that make the paper's tables and figures, and the benchmarks whose tables belong beside them, and
# puts their sections together in FOLDER/RESULTS.md. From the root of the repository. A C compiler is enough; what else
# is missing is left out with a sentence. If one program fails the others go on. Interrupted, or with a failure: what
# was finished is in FOLDER and in its RESULTS.md; a csv as far as it came is in build/, the rows of work_precision in
# build/work_precision/rows.
quick=
[ "$1" = --quick ] && quick=--quick && shift
folder=$1
shift
mkdir -p "$folder" build || exit 1
all_begin=$(date +%s)
failures=
DIST_ORIGIN=$(sh bench/machine.sh)
DIST_COMMIT=${DIST_ORIGIN##*commit }
export DIST_COMMIT DIST_ORIGIN

# What has its section by now: the tracer first, then what is fitted with it.
assemble() {
    {
        echo "# RESULTS"
        echo
        echo "Made by \`make results${quick:+-quick}\`; each section names its own command, the machine and the commit."
        echo "Published numbers are of other shapes, decoders and machines."
        first="pytorch ladder marching threshold work_precision needs code_size"
        for name in $first; do [ -e "$folder/$name.md" ] && echo && cat "$folder/$name.md"; done
        for file in "$folder"/*.md; do
            name=$(basename "$file" .md)
            case " $first RESULTS " in *" $name "*) continue ;; esac
            echo
            cat "$file"
        done
    } >"$folder/RESULTS.tmp" && mv "$folder/RESULTS.tmp" "$folder/RESULTS.md"
}
interrupted() {
    trap - INT TERM
    assemble
    echo "interrupted: $folder/RESULTS.md holds what was finished, now or before; the rest is in build/"
    exit 130
}
trap interrupted INT TERM

# ended NAME BEGIN STATUS: says how long it took, since when all are at it, and whether it failed.
ended() {
    now=$(date +%s)
    echo "$1 took $((now - $2)) s; $(((now - all_begin) / 60)) minutes in all"
    [ "$3" = 0 ] || { echo "$1 ended with an error"; failures="$failures $1"; }
}

for program in "$@"; do
    begin=$(date +%s)
    echo "$program"
    "$program" $quick --out "$folder"
    ended "$program" "$begin" $?
    assemble
done

# csv NAME COMMAND...: its output under a line of its origin; what it says on stderr into FOLDER/NAME.txt, and what it
# has done or skips to the terminal as well. The old table stays until the new one is whole. Status: whether it is.
csv() {
    name=$1 begin=$(date +%s)
    shift
    echo "$name"
    echo "# $DIST_ORIGIN${quick:+; quick}" >"build/$name.csv"
    {
        "$@" 2>&1 >>"build/$name.csv" || echo "ended with an error: $name"
    } | while IFS= read -r line; do
        case $line in "done "* | "in all: "* | "skip "* | *"not installed"*) echo "    $line" >&3 ;; esac
        printf '%s\n' "$line"
    done 3>&1 >"build/$name.txt"
    ! grep -q -x "ended with an error: $name" "build/$name.txt"
    status=$?
    if [ $status = 0 ]; then
        mv "build/$name.csv" "$folder/$name.csv" && mv "build/$name.txt" "$folder/$name.txt"
    else
        tail -n 3 "build/$name.txt"
    fi
    ended "$name" "$begin" $status
    return $status
}

# section NAME TITLE COMMAND: the head of FOLDER/NAME.md; its text and tables follow from stdin
section() {
    {
        printf '## %s\n\n`%s`%s; ' "$2" "$3" "${quick:+ (quick)}"
        printf '[%s.csv](%s.csv)  \n%s\n\n' "$1" "$1" "$DIST_ORIGIN"
        cat
    } >"$folder/$1.md"
}

csv needs build/bench_needs $quick && {
    echo "The embedded model, a picture of 256 x 256 (quick: 96) and, where a gradient is wanted, its adjoint."
    echo "Operations: multiply-adds; done: without those of dead units. Bytes: what context, shape and tape hold, without"
    echo "weights and the caller's planes. Seconds: median of 7."
    echo
    awk -F , '/^#/ { next } { gsub(/,/, " | "); print "| " $0 " |" } !n++ { gsub(/[^|]+/, "---"); print "|" $0 "|" }' \
        "$folder/needs.csv"
} | section needs "What a scene that needs less pays less for" build/bench_needs

csv code_size sh bench/code_size.sh $quick && {
    echo "Bytes of code and constants at -Os; in parentheses what the switch saves. A compiler that is not installed is"
    echo "missing."
    echo
    awk -F , '/^#/ || /^target/ { next }
        !($1 in seen) { seen[$1] = ++targets; target[targets] = $1 }
        !($2 in place) { place[$2] = ++rows; row[rows] = $2 }
        { text[$1, $2] = $3 ($4 > 0 ? " (" $4 ")" : "") }
        END { line = "| left out |"; rule = "|---|"
              for (t = 1; t <= targets; t++) { line = line " " target[t] " |"; rule = rule "---|" }
              print line; print rule
              for (r = 1; r <= rows; r++) { line = "| " row[r] " |"
                  for (t = 1; t <= targets; t++) line = line " " text[target[t], row[r]] " |"
                  print line } }' "$folder/code_size.csv"
} | section code_size "Bytes of code, by what is left out" "sh bench/code_size.sh"

# The same step in PyTorch, where a python3 has it.
for python in python3 /usr/bin/python3 ""; do
    [ -z "$python" ] || ! "$python" -c "import torch" 2>/dev/null || break
done
how="--steps 3"
[ -z "$quick" ] || how="--case embedded --size 64 --steps 1"
if [ -n "$python" ]; then
    csv pytorch "$python" bench/pytorch.py $how && {
        echo "A step of an optimization (a picture with silhouette, losses, gradient for the code, Adam), in PyTorch with the"
        echo "paper's tracer and in dist.h with its own, on the same processor with the same threads in one run;"
        echo "bench/pytorch.py says what was done to PyTorch's advantage. times: of dist.h's cold step."
        echo
        awk -F , '/^#/ { if (/PyTorch/) print substr($0, 3) ".\n"; next }
            !n++ { print "| case | method | device | seconds | times | forward | backward | queries | hits |"
                   print "|---|---|---|---|---|---|---|---|---|"; next }
            { print "| " $1 ", " $4 " pixels | " $2 " | " $3 " | " $6 " | " $11 " | " $7 " | " $8 " | " $9 " | " $10 " |" }' \
            "$folder/pytorch.csv"
    } | section pytorch "The same step in PyTorch" "python3 bench/pytorch.py"
else
    echo "no python3 here has PyTorch (Debian: python3-torch): $folder/pytorch.csv is left as it is, or missing"
fi
assemble

# Every sweep at every size, one scene on each core. The defaults stay in one table, a
# scene's sweeps get their own: in all too large for a file. A plot of each scene and size is in build/work_precision;
# some are shown.
sweep() {
    echo "# $DIST_ORIGIN" >build/work_precision/rows
    build/bench_work_precision --svg build/work_precision/q "$@" >>build/work_precision/rows || return 1
    grep '^case,' build/work_precision/rows
    build/bench_work_precision --list | while read -r name; do grep "^$name," build/work_precision/rows; done
    return 0
}
[ -z "$HAVE" ] || cp "$HAVE" build/have.csv || exit 1
rm -rf build/work_precision
mkdir -p build/work_precision || exit 1
table_size=128
at_once=1
cores=$(nproc 2>/dev/null || getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1)
shown="torus_grazing_128 rods_1e-3_128 embedded_5_128 mug_128 fox_512"
how=
# make results HAVE=FILE: rows of an earlier run of this sweep, under a line of their origin
if [ -n "$HAVE" ] && [ -z "$quick" ]; then
    how="--have build/have.csv"
    DIST_ORIGIN="$DIST_ORIGIN; rows made before: $(sed -n '1s/^# //p' build/have.csv)"
fi
if [ -n "$quick" ]; then
    table_size=64
    shown="embedded_5_64"
    how="--quick --case embedded_5 --largest 128 --window 64 --seconds 0.1"
elif [ "$cores" -ge 2 ]; then
    at_once=$cores
    DIST_ORIGIN="$DIST_ORIGIN; as many scenes at a time"
fi
csv work_precision sweep $how --at-once $at_once && {
    rm -f "$folder"/work_precision_*.csv
    awk -F , -v stem="$folder/work_precision" -v defaults="$folder/work_precision.tmp" '
        /^#/ || /^case/ { head = head $0 "\n"; print >defaults; next }
        $3 == "default" || $3 == "whole" || $3 == "not available" { print >defaults; next }
        { file = stem "_" $1 ".csv" }
        file != last { if (last) close(last); printf "%s", head >file; last = file }
        { print >file }' "$folder/work_precision.csv" && mv "$folder/work_precision.tmp" "$folder/work_precision.csv"
    for name in sizes losses $shown; do
        plot=build/work_precision/q_$name.svg
        [ ! -e "$plot" ] || cp "$plot" "$folder/work_precision_$name.svg"
    done
    echo "Defaults only, $table_size x $table_size pixels: the error of the distance, against a reference in double, that"
    echo "99 % of the hits keep (wrong pixels of the mask; queries a pixel). Every other measure and the times are in the csv,"
    echo "a scene's sweeps of epsilon, alpha, budget and K in work_precision_SCENE.csv. n/a: this processor has no such"
    echo "arithmetic, or the field is no network. In all $(sed -n 's/^in all: //p' "$folder/work_precision.txt"); of large pictures those of"
    echo "a window (column window: pixels along its side), and its pixels are what is counted."
    echo "[work_precision.txt](work_precision.txt): where bounds are violated, where a row of the paper's tracer is cheaper"
    echo "or more exact."
    echo
    awk -F , -v size="$table_size" -v methods="paper_parallel_100 paper_aggressive_50 paper_coarse_to_fine_50 guarded certified guarded_f16 \
guarded_bf16" '
        function cell(m) {
            return " " ((s, m) in text ? text[s, m] : (s, m) in none || (m ~ /16$/ && !net[s]) ? "n/a" : "") " |"
        }
        BEGIN { count = split(methods, method, " ") }
        /^#/ || /^case/ { next }
        !($1 in place) { place[$1] = ++scenes; scene[scenes] = $1 }
        $8 > 0 { net[$1] = 1 }
        $3 == "not available" { none[$1, $2] = 1 }
        $3 == "default" && $5 == size { text[$1, $2] = sprintf("%.0e (%d; %.2g)", $11, $13 + $14, $7) }
        END { line = "| |"; rule = "|---|"
              for (m = 1; m <= count; m++) { line = line " " method[m] " |"; rule = rule "---|" }
              print line; print rule
              for (i = 1; i <= scenes; i++) { s = scene[i]; line = "| " s " |"
                  for (m = 1; m <= count; m++) line = line cell(method[m])
                  print line } }' "$folder/work_precision.csv"
    echo
    echo "The default as pictures grow, in the same way; where errors are a window's, queries a pixel and seconds (median) are"
    echo "the whole picture's."
    echo
    awk -F , '
        /^#/ || /^case/ { next }
        $2 == "guarded" && $3 == "whole" { queries[$1, $5] = $7; seconds[$1, $5] = $9 }
        $2 != "guarded" || $3 != "default" { next }
        !($1 in place) { place[$1] = ++scenes; scene[scenes] = $1 }
        !($5 in seen) { seen[$5] = ++sizes; size[sizes] = $5 }
        !(($1, $5) in seconds) { queries[$1, $5] = $7; seconds[$1, $5] = $9 }
        { text[$1, $5] = sprintf("%.0e (%d; %.2g; %.2g s)", $11, $13 + $14, queries[$1, $5], seconds[$1, $5]) }
        END { line = "| |"; rule = "|---|"
              for (k = 1; k <= sizes; k++) { line = line " " size[k] " x " size[k] " |"; rule = rule "---|" }
              print line; print rule
              for (i = 1; i <= scenes; i++) { line = "| " scene[i] " |"
                  for (k = 1; k <= sizes; k++) line = line " " text[scene[i], size[k]] " |"
                  print line } }' "$folder/work_precision.csv"
    echo
    echo "The epsilons of our default and of the paper's coarse-to-fine row at each size:"
    echo
    echo "![as pictures grow](work_precision_sizes.svg)"
    echo
    echo "Each scene's default against the best of all rows of the paper's tracer, by each measure for itself: above the"
    echo "line dist.h loses."
    echo
    echo "![where dist.h loses](work_precision_losses.svg)"
    echo
    echo "All that was measured of one scene at one size, of some; the program makes it of all."
    for name in $shown; do
        [ -e "$folder/work_precision_$name.svg" ] && printf '\n![%s](work_precision_%s.svg)\n' "$name" "$name"
    done
} | section work_precision "Error against cost" "build/bench_work_precision"
rm -f "$folder/needs.txt" "$folder/code_size.txt" "$folder/pytorch.txt"
assemble
echo "$folder/RESULTS.md"
[ -z "$failures" ] || { echo "failed:$failures; what they had made before stays"; exit 1; }
