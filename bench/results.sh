#!/bin/sh
# sh bench/results.sh [--quick] FOLDER PROGRAM...
# Runs the programs that make the paper's tables and figures, and the benchmarks whose tables belong beside them, and
# puts their sections together in FOLDER/RESULTS.md. From the root of the repository.
quick=
[ "$1" = --quick ] && quick=--quick && shift
folder=$1
shift
mkdir -p "$folder" || exit 1
DIST_COMMIT=$(git describe --always --dirty 2>/dev/null)
DIST_ORIGIN=$(sh bench/machine.sh)
export DIST_COMMIT DIST_ORIGIN

for program in "$@"; do
    begin=$(date +%s)
    echo "$program"
    "$program" $quick --out "$folder" || { echo "$program ended with an error"; exit 1; }
    echo "$program took $(($(date +%s) - begin)) s"
done

# csv NAME COMMAND...: its output under a line of its origin; what it says on stderr into FOLDER/NAME.txt
csv() {
    name=$1 begin=$(date +%s)
    shift
    echo "$name"
    { echo "# $DIST_ORIGIN${quick:+; quick}" && "$@"; } >"$folder/$name.csv" 2>"$folder/$name.txt" ||
        { cat "$folder/$name.txt"; echo "$name ended with an error"; exit 1; }
    echo "$name took $(($(date +%s) - begin)) s"
}

# section NAME TITLE COMMAND: the head of FOLDER/NAME.md; its text and tables follow from stdin
section() {
    {
        printf '## %s\n\n`%s`%s; ' "$2" "$3" "${quick:+ (quick)}"
        printf '[%s.csv](%s.csv)  \n%s\n\n' "$1" "$1" "$DIST_ORIGIN"
        cat
    } >"$folder/$1.md"
}

csv needs build/bench_needs $quick
{
    echo "The embedded model, a picture of 256 x 256 (quick: 96) and, where a gradient is wanted, its adjoint."
    echo "Operations: multiply-adds; done: without those of dead units. Bytes: what context, shape and tape hold, without"
    echo "weights and the caller's planes. Seconds: median of 7."
    echo
    awk -F , '/^#/ { next } { gsub(/,/, " | "); print "| " $0 " |" } !n++ { gsub(/[^|]+/, "---"); print "|" $0 "|" }' \
        "$folder/needs.csv"
} | section needs "What a scene that needs less pays less for" build/bench_needs

csv code_size sh bench/code_size.sh $quick
{
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

# The same step in PyTorch, where a python3 has it; else what is in FOLDER already stays.
for python in python3 /usr/bin/python3 ""; do
    [ -z "$python" ] || ! "$python" -c "import torch" 2>/dev/null || break
done
if [ -n "$python" ]; then
    csv pytorch "$python" bench/pytorch.py ${quick:+--case embedded --size 64} --steps 3
    {
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
fi

# Sweeps at one size, defaults at all; build/bench_work_precision --long sweeps at each. Plots of some: each is 0.2 MB.
# About half an hour on one thread, of which the slow decoders take two minutes each.
mkdir -p build/work_precision || exit 1
if [ -n "$quick" ]; then
    csv work_precision build/bench_work_precision --quick --case embedded_5 --largest 128 --sweep 64 \
        --svg build/work_precision/q
    table_size=64
    cp build/work_precision/q_losses.svg "$folder/work_precision_losses.svg" || exit 1
    shown="embedded_5_64"
else
    rm -f build/work_precision/*.svg
    csv work_precision build/bench_work_precision --largest 1024 --sweep 128 --minutes 0.35 --svg build/work_precision/q
    table_size=128
    cp build/work_precision/q_losses.svg "$folder/work_precision_losses.svg" || exit 1
    shown="torus_grazing_128 rods_1e-3_128 embedded_5_128 mug_128"
fi
for name in $shown; do
    plot=build/work_precision/q_$name.svg
    [ ! -e "$plot" ] || cp "$plot" "$folder/work_precision_$name.svg"
done
{
    echo "Defaults only, $table_size x $table_size pixels: the error of the distance, against a reference in double, that"
    echo "99 % of the hits keep (wrong pixels of the mask; queries a pixel). The sweeps of epsilon, alpha, budget and K, every"
    echo "other measure and the times are in the csv. n/a: this processor has no such arithmetic, or the field is no network;"
    echo "empty: left out for its time. [work_precision.txt](work_precision.txt): where bounds are violated, where a row of"
    echo "the paper's tracer is cheaper or more exact, what was left out."
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
    echo "The default as pictures grow, in the same way, with the median of the seconds. Of pictures larger than 256 x 256"
    echo "(chairs_3, spot_512 and spot_512_he: than 128 x 128, and none beyond 256) as many pixels, spread evenly, are"
    echo "compared, and counted."
    echo
    awk -F , '
        /^#/ || /^case/ { next }
        $2 != "guarded" || $3 != "default" { next }
        !($1 in place) { place[$1] = ++scenes; scene[scenes] = $1 }
        !($5 in seen) { seen[$5] = ++sizes; size[sizes] = $5 }
        { text[$1, $5] = sprintf("%.0e (%d; %.2g; %.2g s)", $11, $13 + $14, $7, $9) }
        END { line = "| |"; rule = "|---|"
              for (k = 1; k <= sizes; k++) { line = line " " size[k] " x " size[k] " |"; rule = rule "---|" }
              print line; print rule
              for (i = 1; i <= scenes; i++) { line = "| " scene[i] " |"
                  for (k = 1; k <= sizes; k++) line = line " " text[scene[i], size[k]] " |"
                  print line } }' "$folder/work_precision.csv"
    echo
    echo "Each scene's default against the best of all rows of the paper's tracer, by each measure for itself: above the"
    echo "line dist.h loses."
    echo
    echo "![where dist.h loses](work_precision_losses.svg)"
    for name in $shown; do
        [ -e "$folder/work_precision_$name.svg" ] && printf '\n![%s](work_precision_%s.svg)\n' "$name" "$name"
    done
} | section work_precision "Error against cost" "build/bench_work_precision"
rm -f "$folder/needs.txt" "$folder/code_size.txt" "$folder/pytorch.txt"

{
    echo "# RESULTS"
    echo
    echo "Made by \`make results${quick:+-quick}\`; each section names its own command, the machine and the commit."
    echo "Published numbers are of other shapes, decoders and machines."
    # The tracer first, then what is fitted with it.
    first="pytorch ladder marching threshold work_precision needs code_size"
    for name in $first; do [ -e "$folder/$name.md" ] && echo && cat "$folder/$name.md"; done
    for file in "$folder"/*.md; do
        name=$(basename "$file" .md)
        case " $first RESULTS " in *" $name "*) continue ;; esac
        echo
        cat "$file"
    done
} >"$folder/RESULTS.tmp" && mv "$folder/RESULTS.tmp" "$folder/RESULTS.md"
echo "$folder/RESULTS.md"
