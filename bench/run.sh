#!/bin/sh
# All benchmarks in short, printed and written to bench/results: NAME.csv, whose first line names machine and commit,
# and plots NAME*.svg (work_precision: plots into build; bench/results has what make results makes). From the root of
# the repository, with the programs built in build/: make bench.
#
#   sh bench/run.sh [NAME...]      all, or only these: net blas step trace grow cache scene needs fit work_precision
#                                  code_size

results=bench/results
names=${*:-net blas step trace grow cache scene needs fit work_precision code_size}
mkdir -p "$results" || exit 1
DIST_ORIGIN=$(sh bench/machine.sh)
export DIST_ORIGIN
if [ -z "$OPENBLAS_CORETYPE" ]; then # in virtual machines OpenBLAS may take a processor of long ago for ours
    if grep -qs avx512f /proc/cpuinfo; then
        export OPENBLAS_CORETYPE=SKYLAKEX
    elif grep -qs avx2 /proc/cpuinfo; then
        export OPENBLAS_CORETYPE=HASWELL
    fi
fi
failed=0

# csv NAME COMMAND...: the command's CSV under a line of its origin
csv() {
    name=$1
    shift
    begin=$(date +%s)
    echo "## $name: $*"
    {
        echo "# $DIST_ORIGIN; $*"
        "$@" || echo "$name" >"$results/failed"
    } | tee "$results/$name.csv"
    echo "## $name: $(($(date +%s) - begin)) s"
    if [ -e "$results/failed" ]; then
        rm -f "$results/failed"
        echo "bench: $name failed" >&2
        failed=1
        return 1
    fi
}

# dots NAME ENDING TITLE OPTIONS...: a picture of NAME.csv
dots() {
    name=$1 ending=$2 title=$3
    shift 3
    build/plot_csv "$results/$name.csv" "$results/$name$ending.svg" --title "$title" "$@" || failed=1
}

start=$(date +%s)
for bench in $names; do
    program=build/bench_$bench
    case $bench in
    net)
        csv net "$program" --quick &&
            dots net '' 'Networks: share of the multiply-add peak measured in the same seconds' \
                --rows case,isa,threads --series mode --panel share:1:peak --panel queries_per_s:log \
                --panel of_forward
        ;;
    blas)
        csv blas "$program" --quick &&
            dots blas '' 'Dense chains beside OpenBLAS and oneDNN' --rows case,threads,mode --series library \
                --panel share:1:peak --panel queries_per_s:log --columns 2
        ;;
    step)
        csv step "$program" --quick --size 512 --steps 5 &&
            dots step '' 'A step of an optimization, and frames' --rows case,resolution --series mode \
                --panel seconds:log --panel ratio:log --panel queries:log \
                --note 'ratio: to the time of 887,000 queries at the peak measured in the same run'
        ;;
    trace)
        csv trace "$program" --quick &&
            dots trace '' 'Both tracers: queries, time and error' --rows case,resolution --series method \
                --panel queries:log --panel seconds:log --panel mean_error:log --panel p99_error:log --panel holes \
                --panel false_hits --open holes:10 --open-means 'more than 10 holes'
        ;;
    cache)
        csv cache "$program" && dots cache '' 'What a cache of empty space saves' --rows case,resolution \
            --panel of_queries --panel of_seconds --columns 2 \
            --note 'of what the same rays, or spheres, take without one (resolution 0)'
        ;;
    scene)
        csv scene "$program" --quick && dots scene '' 'Instances of one network' --rows case \
            --panel of_one --panel per_query --panel picture_seconds --columns 3 \
            --note 'of_one: time of a query over that of the network alone; per_query: networks asked for one'
        ;;
    needs)
        csv needs "$program" && dots needs '' 'What a scene that needs less pays less for' --rows need \
            --panel queries:log --panel seconds:log --panel bytes --columns 3
        ;;
    fit)
        csv fit "$program" --quick && dots fit '' 'Which gradient fits: error left and what it took' \
            --rows trace,gradient,samples --series case --panel ratio --panel iou_end --panel queries:log \
            --note 'ratio: depth error at the end over that at the start'
        ;;
    code_size)
        csv code_size sh bench/code_size.sh &&
            dots code_size '' 'Bytes of code at -Os, by what is left out' --rows 'left out' --series target \
                --panel bytes --panel saved --columns 2
        ;;
    work_precision)
        "$program" --quick --size 128 --svg build/work_precision_quick || failed=1 # bench/results: make results
        ;;
    *)
        csv "$bench" "$program" --quick --svg "$results/$bench"
        ;;
    esac
done
echo "## all: $(($(date +%s) - start)) s; $(du -sk "$results" | cut -f 1) KiB in $results"
exit $failed
