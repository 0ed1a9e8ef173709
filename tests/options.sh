#!/bin/sh
# Each switch of the table at the top of dist.h, alone and all together.
. tests/script.sh

sed -n '/^   Options/,/^$/p' dist.h | grep -o 'DIST_NO_[A-Z_]*' | sort -u >"$work/table"
code dist.h | grep -o 'DIST_NO_[A-Z_]*' | sort -u >"$work/used"
if [ ! -s "$work/table" ]; then
    not_ok option_table "no DIST_NO_ switch found in it"
    exit 1
fi
diff "$work/table" "$work/used" | grep '^[<>]' >"$work/difference"
expect_nothing option_table_names_the_switches_in_use "$work/difference"

# build NAME FLAGS...: the library in NAME.o and a small program, with all warnings, run.
build() {
    name=$1
    shift
    expect "$name" $CC -std=c99 -O0 $warnings -Wmissing-prototypes -DSMALL_LIBRARY "$@" -c tests/small.c \
        -o "$work/$name.o" || return 0
    expect "${name}_links" $CC -std=c99 -O0 $warnings -Wmissing-prototypes "$@" tests/small.c "$work/$name.o" \
        -o "$work/program" -lm || return 0
    "$work/program" >"$work/answer" 2>&1 && ok "${name}_runs" || not_ok "${name}_runs" "$(head -n 1 "$work/answer")"
}

# The kernels, which take three quarters of the time, know no switch but the one of the 16-bit ones.
all=
while read -r switch; do
    plain=-DDIST_NO_SIMD
    case $switch in *_HALF | *_SIMD) plain= ;; esac
    build "$switch" $plain "-D$switch"
    all="$all -D$switch"
done <"$work/table"
sed -n '/^\/\*@ 03 /,/^\/\*@ 04 /p' dist.h | grep -n 'DIST_NO_\|DIST_ASSERT' >"$work/found"
expect_nothing kernels_know_no_switch "$work/found"
build all_together $all
# These are one file, since what is static cannot be linked.
one_file() {
    name=$1
    shift
    expect "$name" $CC -std=c99 -O0 $warnings -Wmissing-prototypes -DDIST_IMPLEMENTATION "$@" tests/small.c \
        -o "$work/program" -lm || return 0
    "$work/program" >"$work/answer" 2>&1 && ok "${name}_runs" || not_ok "${name}_runs" "$(head -n 1 "$work/answer")"
}
one_file DIST_STATIC -DDIST_STATIC
one_file DIST_STATIC_and_all $all -DDIST_STATIC
one_file DIST_API -DDIST_NO_SIMD '-DDIST_API=extern __attribute__((visibility("hidden")))'
one_file DIST_ASSERT -DDIST_NO_SIMD '-DDIST_ASSERT(x)=((x) ? (void)0 : __builtin_trap())'
one_file NDEBUG -DDIST_NO_SIMD -DNDEBUG
for cc in clang; do
    if have $cc; then
        expect "all_together_$cc" $cc -std=c99 $warnings -Wmissing-prototypes -DSMALL_LIBRARY $all -c tests/small.c \
            -o "$work/c.o"
        expect "DIST_STATIC_$cc" $cc -std=c99 $warnings -Wmissing-prototypes -DDIST_IMPLEMENTATION -DDIST_STATIC \
            -DDIST_NO_SIMD -c tests/small.c -o "$work/c.o"
    else
        skip "all_together_$cc" "$cc is not installed"
    fi
done
if have "$CXX"; then
    expect all_together_cxx $CXX -x c++ -std=c++11 $warnings -DSMALL_LIBRARY $all -c tests/small.c -o "$work/c.o"
    expect DIST_STATIC_cxx $CXX -x c++ -std=c++11 $warnings -DDIST_IMPLEMENTATION -DDIST_STATIC -DDIST_NO_SIMD \
        -c tests/small.c -o "$work/c.o"
fi

# A picture and nothing else: where the compiler sees that there is no tape, it may warn of what is done with one.
cat >"$work/picture.c" <<'END'
#include "dist.h"
int main(void)
{
    float ball[4] = {0, 0, 0, 1}, eye[3] = {0, 0, 3}, depth[64];
    dist_context *ctx = dist_context_create(NULL);
    dist_field field = dist_field_sphere(ball);
    dist_camera camera = dist_camera_look_at(8, 8, 1.0f, eye, NULL, NULL);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    dist_status status = dist_render(ctx, &field, &camera, NULL, &out, NULL);
    dist_context_destroy(ctx);
    return (int)status;
}
END
for level in 1 2 3 s; do
    expect "DIST_STATIC_at_O$level" $CC -std=c99 $warnings -DDIST_IMPLEMENTATION -DDIST_STATIC -DDIST_NO_SIMD -O$level -I. \
        -c "$work/picture.c" -o "$work/c.o"
done

# What a switch promises to leave out, it does leave out.
if ! have nm; then
    skip left_out "nm is not installed"
    exit 0
fi
# without SWITCH PATTERN: no undefined or own symbol of its library matches.
without() {
    nm "$work/$1.o" >"$work/nm" 2>/dev/null && [ -s "$work/nm" ] || { not_ok "$1_leaves_out" "there is no library"; return; }
    grep -E " ($2)$" "$work/nm" >"$work/left"
    expect_nothing "$1_leaves_out" "$work/left"
}
without DIST_NO_LIBC_ALLOC 'U (malloc|free|calloc|realloc|aligned_alloc|posix_memalign)'
without DIST_NO_STDIO 'U (f(open|read|write|close|seek|tell|puts|putc|getc|gets|printf|flush)|std(in|out|err)|remove|rename)|. dist_[a-z_]*_(load_file|save_file|pfm_load|pfm_save)'
without DIST_NO_BACKWARD '[Tt] dist_[a-z_]*backward|[Tt] dist_adam_step'
without DIST_NO_TRAIN '[Tt] dist_net_(create|set_weights|set_code)'
without DIST_NO_MESH '[Tt] dist_(mesh_[a-z]*|chamfer)'
without DIST_NO_SIMD '[Tt] disti?_[a-z_0-9]*_(sse2|avx2|avx512|neon)'
without DIST_NO_HALF '[Tt] disti_[a-z_]*_b?f16'
$CC -DDIST_IMPLEMENTATION -DDIST_STATIC -DDIST_NO_SIMD -c tests/small.c -o "$work/c.o" 2>/dev/null
nm "$work/c.o" 2>/dev/null | grep ' [TWV] dist' >"$work/left"
expect_nothing DIST_STATIC_exports_nothing "$work/left"
