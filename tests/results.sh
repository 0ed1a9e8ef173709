#!/bin/sh
# The programs of make results run, write what they should, and say what must always be so.
. tests/script.sh

folder=build/results
rm -rf "$folder"
if ! make -s --no-print-directory results-quick >"$work/log" 2>&1; then
    not_ok results_quick_ends_well "its last lines are:"
    tail -n 4 "$work/log" | sed 's/^/    /'
    exit 1
fi
ok results_quick_ends_well

# columns NAME COLUMNS: what the table's first columns are called.
columns() {
    said=$(grep -v '^#' "$folder/$1.csv" 2>/dev/null | head -n 1)
    case $said in
    "$2"*) ok "columns_of_$1" ;;
    *) not_ok "columns_of_$1" "$said" ;;
    esac
}
columns ladder case,method,steps,resolution,rays_in_sphere,queries,queries_with_silhouette,forward_seconds,step_seconds
columns marching degrees,alpha,formula_steps,paper_queries,paper_error,dist_queries,dist_error
columns marching_holes shape,alpha,tracer,resolution,hits,holes
columns threshold tracer,epsilon,resolution,pixels,dilation,erosion
columns photos part,family,target,seed,level,method,width,views,iterations,chamfer1000_start,chamfer1000_end
columns pose degrees_start,distance_start,trial,shape,method,degrees_end,distance_end,found,explained
columns needs need,size,rays,queries,backward
columns code_size 'target,left out,bytes,saved'
columns work_precision case,method,parameter,value,resolution,queries,queries_per_pixel
columns work_precision_embedded_5 case,method,parameter,value,resolution,queries,queries_per_pixel
columns pose_curve method,degrees_start,step,degrees_quarter,degrees_median

for name in ladder marching threshold photos pose completion; do
    [ -s "$folder/$name.csv" ] && [ -s "$folder/$name.svg" ] && ok "table_and_plot_of_$name" ||
        not_ok "table_and_plot_of_$name" "one of them is not there"
done
for file in $(ls "$folder"/*.md | grep -v RESULTS); do
    grep -q -x -F "$(grep -m 1 '^## ' "$file")" "$folder/RESULTS.md" || echo "$file is not in RESULTS.md"
done >"$work/found"
for file in "$folder"/*.svg; do tail -n 1 "$file" | grep -q '</svg>' || echo "$file has no end"; done >>"$work/found"
expect_nothing sections_and_plots_are_whole "$work/found"
[ -s "$folder/threshold.png" ] || [ -s "$folder/threshold.ppm" ] && ok picture_of_thresholds ||
    not_ok picture_of_thresholds "it is not there"

# Every table: the machine first; rows as long as the heads; nothing NaN or infinite (empty: not measured).
for file in "$folder"/*.csv; do
    head -n 1 "$file" | grep -v -q '^# .* cores; .*; dist.h [0-9]' && echo "$file does not say where it was made"
    awk -F , -v file="$file" '/^#/ { next } { gsub(/"[^"]*"/, "text") } !n { n = NF; next }
        NF != n || tolower($0) ~ /(^|[,-])(nan|inf)/ { print file ": " $0 }
        { rows++ } END { if (!rows) print file ": no row" }' "$file"
done >"$work/found"
expect_nothing tables_are_whole "$work/found"
grep -n -i -w -e nan -e inf "$folder/RESULTS.md" >"$work/found"
expect_nothing sections_hold_numbers "$work/found"

# Error against cost: every parameter's row of every method at every size, and what the whole of a picture takes.
cat "$folder"/work_precision.csv "$folder"/work_precision_embedded_5.csv 2>/dev/null | awk -F , '/^#|^case/ { next }
    { n[$5]++; whole[$5] += $3 == "whole"; of[$5 " " $2 " " $3 " " $4]++ }
    END { for (k in of) if (of[k] != 1) print k ": " of[k] " rows"
          if (n[64] < 80 || n[128] != n[64] + 1 || whole[64] || whole[128] != 1) {
              print n[64] " rows at 64, " n[128] " at 128, " whole[128] " of the whole" } }' >"$work/found"
expect_nothing no_row_of_error_against_cost_is_missing "$work/found"

# Ours has no more holes than any row of the paper's, in the ladder and at every alpha.
awk -F , '/^#/ || /^case/ { next } { sub(/^"[^"]*"/, "text") } { key = $3 }
    $2 ~ /^paper/ && (!(key in least) || $11 < least[key]) { least[key] = $11 }
    $2 == "guarded" || $2 == "certified" { ours[key " " $2] = $11; key_of[key " " $2] = key }
    END { for (k in ours) { n++; if (ours[k] + 0 > least[key_of[k]] + 0) print k ": " ours[k] " holes" }
          if (n != 4) print n " rows of ours" }' "$folder/ladder.csv" >"$work/found"
expect_nothing ladder_no_more_holes_than_the_paper "$work/found"
awk -F , '/^#/ || /^shape/ { next } { sub(/^"[^"]*"/, $1 == "" ? "" : "text") } { print }' "$folder/marching_holes.csv" |
    awk -F , '$3 == "paper" { paper = $6; next } { n++ } $6 + 0 > paper + 0 { print } END { if (n != 50) print n " rows" }' \
        >"$work/found"
expect_nothing marching_no_more_holes_than_the_paper "$work/found"
# The paper's example, and our count below both.
[ "$(awk -F , '$1 == 10 && ($2 == "1.0" || $2 == "1.5") { printf "%s ", $3 }' "$folder/marching.csv")" = "52 33 " ] &&
    ok steps_at_10_degrees_as_published || not_ok steps_at_10_degrees_as_published "the formula gives others"
awk -F , '/^#/ || /^degrees/ { next } $1 <= 20 && $6 >= $4 { print }' "$folder/marching.csv" >"$work/found"
expect_nothing fewer_steps_than_the_paper_at_low_angles "$work/found"
awk -F , '$1 == "paper" { d[$2 + 0] = $5 } END { if (!(d[5e-2] > d[5e-4] && d[5e-4] >= d[5e-6])) print "not so" }' \
    "$folder/threshold.csv" >"$work/found"
expect_nothing larger_thresholds_dilate_more "$work/found"
awk -F , '/^#/ || /^part/ { next } $6 == "rays" && $11 + 0 >= $10 + 0 { print }' "$folder/photos.csv" >"$work/found"
expect_nothing photo_fits_by_rays_come_nearer "$work/found"
sed 's/"[^"]*Adam",/adam,/; s/"and Gauss-Newton",/newton,/; s/"and new tries",/tries,/' "$folder/pose.csv" |
    awk -F , '$5 == "newton" || $5 == "tries" { n[$5] += $9 } END { if (!(n["tries"] >= n["newton"])) print "not so" }' \
        >"$work/found"
expect_nothing new_tries_lose_no_camera "$work/found"

expect readme_holds_the_tables_of_bench_results sh bench/readme.sh --check

# Rows of an earlier run are taken over, and made again where one of them is damaged, wherever it stands.
sweep="build/bench_work_precision --case sphere --size 64 --quick"
taken() { $sweep --have "$1" 2>&1 >/dev/null | grep -c 'by an earlier run'; }
$sweep >"$work/first.csv" 2>/dev/null
rows=$(grep -c ^sphere "$work/first.csv")
again=$(taken "$work/first.csv")
for row in $((rows / 2)) "$rows"; do # a count that is not there
    awk -F , -v OFS=, -v row="$row" '/^sphere/ && ++n == row { $18 = "" } { print }' "$work/first.csv" >"$work/second.csv"
    again="$again $(taken "$work/second.csv")"
done
[ "$rows" -gt 10 ] && [ "$again" = "1 0 0" ] && ok only_whole_runs_are_taken_over ||
    not_ok only_whole_runs_are_taken_over "$rows rows; taken over: $again, not 1 0 0"
