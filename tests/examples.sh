#!/bin/sh
# Every example compiles by itself, from the root, with nothing but the C compiler.
. tests/script.sh

found=
for file in examples/*.c; do
    [ -e "$file" ] || continue
    found=1
    name=$(basename "$file" .c)
    # Without optimization, which make asks for already.
    expect "${name}_compiles_alone" $CC -Wall -Werror -fsyntax-only "$file"
    expect "${name}_links_alone_and_is_strict" $CC -std=c99 $warnings -Wmissing-prototypes "$file" -lm -o "$work/$name"
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
expect fit_depth_reports reports "$work/fit_depth" --demo --size 32 --iterations 2
for file in bench/*.c tools/*.c; do
    [ -e "$file" ] || continue
    name=$(basename "$file" .c)
    expect "${name}_is_strict" $CC -std=c99 -O0 $warnings -Wmissing-prototypes -isystem build/stb/usr/include \
        -c "$file" -o "$work/$name.o"
done
[ -n "$found" ] || skip examples "there are none"
