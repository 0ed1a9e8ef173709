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
for file in bench/*.c tools/*.c; do
    [ -e "$file" ] || continue
    name=$(basename "$file" .c)
    expect "${name}_is_strict" $CC -std=c99 -O0 $warnings -Wmissing-prototypes -isystem build/stb/usr/include \
        -c "$file" -o "$work/$name.o"
done
[ -n "$found" ] || skip examples "there are none"
