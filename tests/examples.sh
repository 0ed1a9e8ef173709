#!/bin/sh
# Every example compiles by itself, from the root, with nothing but the C compiler.
. tests/script.sh

make -s --no-print-directory build/inside.o || exit 1
found=
for file in examples/*.c; do
    [ -e "$file" ] || continue
    found=1
    name=$(basename "$file" .c)
    # Without optimization, which make asks for already.
    expect "${name}_compiles_alone" $CC -Wall -Werror -fsyntax-only "$file"
    # One file and one command, as the README says; without the kernels, which take three quarters of the time. The
    # others are linked below with the tests' translation of the same text.
    case $name in
    hello | arena) expect "${name}_links_alone_and_is_strict" $CC -std=c99 $warnings -Wmissing-prototypes \
        -DDIST_NO_SIMD "$file" -lm -o "$work/$name" ;;
    *) expect "${name}_is_strict" $CC -std=c99 $warnings -Wmissing-prototypes -DDIST_NO_SIMD -fsyntax-only "$file" ;;
    esac
    [ "$name" = arena ] || expect "${name}_links_with_a_library" $CC -std=c99 $warnings -Wmissing-prototypes -O1 \
        -DDIST_IMPLEMENTED "$file" build/inside.o -lm -o "$work/$name"
    if have clang && [ "$CC" != clang ]; then
        expect "${name}_is_strict_clang" clang -std=c99 $warnings -Wmissing-prototypes -fsyntax-only "$file"
    fi
done
# In a fixed arena: as many bytes used as were asked for, and no allocator of the C library's linked in.
expect arena_runs_in_what_it_asked_for "$work/arena"
nm -u "$work/arena" 2>/dev/null | grep -E ' (malloc|calloc|realloc|aligned_alloc|posix_memalign|free)(@|$)' >"$work/found"
expect_nothing arena_links_no_malloc "$work/found"
# --report: every row is there, each number is one, and shares and parts are not larger than the whole.
reports() {
    "$@" --report --out "$work/report" >"$work/rows" && awk '
        /^  error +cost$/ { on = 1; next }
        on && /^  / { for (at = 0; at < 2; at++) {
                    name = substr($0, 1 + 38 * at, 24); gsub(/^ +| +$/, "", name)
                    number = substr($0, 25 + 38 * at, 14); gsub(/ /, "", number)
                    if (number !~ /^[0-9][0-9.]*(e[-+][0-9]+)?$/) { print "error: " name " is \"" number "\""; bad = 1 }
                    v[name] = number + 0; rows++ } }
        END { if (rows < 26 || !(v["hits"] > 0) || !(v["bytes of memory"] > 0) || !(v["truth: queries"] > 0)) bad = 1
              if (v["share within bound"] < 0.9 || v["share within bound"] > 1) bad = 1
              if (v["bound, median"] > v["bound, p99"] || v["bound, p99"] > v["bound, largest"]) bad = 1
              if (v["true error, median"] > v["true error, p99"] || v["true error, p99"] > v["true error, largest"]) bad = 1
              sum = v["cones"] + v["march"] + v["refine"] + v["silhouette"] + v["normals"] + v["colors"]
              if (sum != v["queries"] || v["multiply-adds done"] > v["multiply-adds asked"]) bad = 1
              exit bad }' "$work/rows"
}
expect render_reports reports "$work/render" embedded --size 48
certified_reports() {
    reports "$work/render" embedded --size 48 --trace certified && grep -q '"trace": "certified"' "$work/report.json" &&
        grep -q '^  holes  *0 ' "$work/rows"
}
expect certified_pictures_have_no_holes certified_reports
expect fit_depth_reports reports "$work/fit_depth" --demo --size 32 --iterations 2
# A fit says whether it has come to nothing: RATE RISEN.
fit_says() {
    risen=0
    "$work/fit_depth" --demo --size 32 --iterations 8 --rate "$1" --out "$work/rate" >"$work/said" || return
    grep -q "the loss has not fallen: try a --rate below $1," "$work/said" && risen=1
    [ "$risen" = "$2" ] || { cat "$work/said"; return 1; }
}
expect a_fit_that_diverges_says_so fit_says 10 1
expect a_fit_that_falls_says_no_such_thing fit_says 0.01 0
expect two_photos_are_enough "$work/fit_photos" --views 2 --size 24x24 --iterations 6 --out "$work/two"
# Every fit's report has the same names, with numbers wherever the truth is known: PROGRAM and its arguments.
tells_all() {
    "$@" --out "$work/told" >"$work/said" || { cat "$work/said"; return 1; }
    for key in loss_start loss_end depth_error_start depth_error_end iou_start iou_end chamfer_start chamfer_end queries \
        seconds iterations; do
        grep -q "^  \"$key\": [0-9]" "$work/told.json" || { echo "no number of $key"; return 1; }
    done
}
expect fit_depth_tells_all tells_all "$work/fit_depth" --demo --size 32 --iterations 2
sees_the_demo() { grep -q '^  "observed": "the demo' "$work/told.json"; }
expect fit_depth_tells_what_was_observed sees_the_demo
expect fit_depth_tells_all_of_a_target tells_all "$work/fit_depth" --size 32 --iterations 2
# The mask may be another picture's, with the depth of a shape of the model, too.
masked() {
    "$work/render" embedded --code 1 --size 32x32 --planes depth --out "$work/mask" &&
        tells_all "$work/$1" --target 0 --size 32x32 --iterations 2 --mask "$work/mask_depth.pfm" &&
        seen=$(sed -n 's/^  "pixels_seen": \([0-9]*\).*/\1/p' "$work/told.json") &&
        tells_all "$work/$1" --target 0 --size 32x32 --iterations 2 &&
        all=$(sed -n 's/^  "pixels_seen": \([0-9]*\).*/\1/p' "$work/told.json") && [ "$seen" -lt "$all" ]
}
expect fit_depth_takes_a_mask masked fit_depth
expect fit_pose_takes_a_mask masked fit_pose
expect fit_pose_tells_all tells_all "$work/fit_pose" --size 32 --iterations 2 --restarts 0
expect fit_photos_tells_all tells_all "$work/fit_photos" --views 3 --size 24x24 --iterations 2
expect fit_photos_of_a_mesh_tell_all tells_all "$work/fit_photos" --views 3 --size 24x24 --iterations 2 --gradient mesh
# What cannot be done is refused with a sentence, and nothing else happens: NAME WORDS COMMAND...
refuses() {
    refused=$1 words=$2
    shift 2
    if "$@" >"$work/said" 2>&1; then
        not_ok "$refused" "it ended well"
    elif [ $? -gt 2 ] || ! grep -q -F -e "$words" "$work/said" || [ "$(wc -l <"$work/said")" -gt 2 ]; then
        not_ok "$refused" "it should say \"$words\", and says:"
        head -n 3 "$work/said" | sed 's/^/    /'
    else
        ok "$refused"
    fi
}
refuses unknown_arguments "unknown argument --sise" "$work/render" embedded --sise 64 --out "$work/x"
refuses no_model "which model?" "$work/render" --out "$work/x"
refuses a_model_that_is_not_there "$work/none.safetensors" "$work/render" "$work/none.safetensors" --out "$work/x"
refuses a_model_that_is_none "tests/examples.sh" "$work/mesh" tests/examples.sh --out "$work/x.ply"
refuses pictures_of_no_pixel "WIDTHxHEIGHT" "$work/render" embedded --size 0x5 --out "$work/x"
refuses pictures_too_large "WIDTHxHEIGHT" "$work/render" embedded --size 16385x4 --out "$work/x"
refuses numbers_that_are_none "a number from" "$work/render" embedded --fov nan --out "$work/x"
refuses numbers_out_of_range "numbers go from -1e9 to 1e9" "$work/render" embedded --eye 1e30,0,0 --out "$work/x"
refuses an_eye_that_looks_at_itself "the same point" "$work/render" embedded --eye 1,1,1 --at 1,1,1 --out "$work/x"
refuses a_code_that_is_not_there "the model stores" "$work/render" embedded --code 999999 --out "$work/x"
refuses lights_below_0 "no color below 0" "$work/render" embedded --light 1,0,0,-1,0,0 --out "$work/x"
refuses meshes_of_other_formats "FILE.obj is needed" "$work/mesh" embedded --out "$work/x.stl"
refuses a_fit_of_nothing "nothing to fit" "$work/fit_depth" --demo --weights 0,0,1 --out "$work/x"
refuses weights_below_0 "must not be negative" "$work/fit_depth" --demo --weights 1,-1,0 --out "$work/x"
refuses a_mask_of_another_size "but the depth image is" "$work/fit_depth" --size 33 --mask "$work/mask_depth.pfm" --out "$work/x"
refuses a_code_to_begin_with_of_a_known_shape "the shape is known" "$work/fit_pose" --start zero --out "$work/x"
refuses trials_with_a_mask "renders its own observations" "$work/fit_pose" --trials 2 --mask "$work/mask_depth.pfm"
refuses a_demo_with_a_mask "its own shape" "$work/fit_depth" --demo --mask "$work/mask_depth.pfm" --out "$work/x"
refuses a_demo_of_a_family_without_demo "they mean nothing" "$work/fit_depth" --demo-family planes --target 0 --out "$work/x"
refuses two_observations "two observations" "$work/fit_photos" --photos none.txt --target 1 --out "$work/x"
refuses starts_off_below_0 "0 to 180 degrees" "$work/fit_pose" --off -1,0 --out "$work/x"
mkdir -p "$work/seen" && printf 'P6 # by hand\n# twice\n1 1#\n255\nabc' >"$work/seen/one.ppm" &&
    echo "one.ppm nan 1 0 0 1 0 0 0 1 0 0 0 1 0 0 3" >"$work/seen/cameras.txt"
refuses a_photo_without_a_camera "one.ppm: dist_tape_create: camera.fx is nan" "$work/fit_photos" --photos "$work/seen" --out "$work/x"
# Comments in a photo's header move no pixel of it.
comments_move_nothing() {
    "$work/fit_photos" --views 2 --size 24x24 --iterations 1 --save "$work/photos" --out "$work/taken" &&
        "$work/fit_photos" --photos "$work/photos" --iterations 1 --out "$work/plain" || return
    for photo in "$work"/photos/*.ppm; do
        { printf 'P6 # by hand\n' && tail -c +4 "$photo"; } >"$work/photo" && mv "$work/photo" "$photo" || return
    done
    "$work/fit_photos" --photos "$work/photos" --iterations 1 --out "$work/commented" || return
    for of in plain commented; do grep '"loss_' "$work/$of.json" >"$work/$of.loss"; done
    cat "$work/plain.loss" && [ -s "$work/plain.loss" ] && cmp "$work/plain.loss" "$work/commented.loss"
}
expect photos_with_comments_are_the_same comments_move_nothing
refuses weights_of_no_code "there is no code" "$work/fit_pose" --weights 1,1,5 --out "$work/x"
refuses starts_off_too_far "a distance of 0 to 1000" "$work/fit_pose" --off 5,1e9 --out "$work/x"
refuses a_fit_of_what_is_not_seen "nothing to fit" "$work/fit_depth" --demo --no-mask --weights 0,1,0 --out "$work/x"
refuses a_code_that_is_no_word "no INDEX" "$work/render" embedded --code nan --out "$work/x"
refuses a_mesh_where_none_can_be "cannot be written" "$work/mesh" embedded --out "$work/render/x.ply"
refuses a_folder_as_a_stem "is a folder" "$work/render" embedded --out "$work"
refuses options_without_effect "belongs to" "$work/fit_photos" --mesh-cells 20 --out "$work/x"
refuses starts_of_no_similarity "where --similarity starts" "$work/fit_photos" --off 5,5,0.1 --out "$work/x"
refuses starts_off_of_photos "say --place" "$work/fit_photos" --photos "$work/seen" --similarity --off 5,5,0.1 --out "$work/x"
refuses samples_of_no_shaded_picture "asks for none" "$work/render" embedded --planes depth --samples-per-pixel 2 --out "$work/x"
refuses lengths_that_differ "three ways" "$work/train" --steps 2 --epochs 2 --out "$work/x"
refuses an_output_that_cannot_be "cannot be written" "$work/train" --steps 2 --out "$work"
refuses arguments_where_there_are_none "takes no arguments" "$work/hello" --size 8
ls "$work"/x* >"$work/found" 2>/dev/null
expect_nothing refusals_write_no_file "$work/found"
for file in bench/*.c; do
    [ -e "$file" ] || continue
    name=$(basename "$file" .c)
    # What the optimizer finds, make says: it builds them with the same warnings.
    plain=-DDIST_NO_SIMD
    grep -q -e disti_ -e '"peak.h"' "$file" && plain=
    expect "${name}_is_strict" $CC -std=c99 $warnings -Wmissing-prototypes $plain -isystem build/stb/usr/include \
        -fsyntax-only "$file"
done
[ -n "$found" ] || skip examples "there are none"
