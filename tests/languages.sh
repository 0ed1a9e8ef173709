#!/bin/sh
# The header under every language version and compiler, with all warnings, and in every order of inclusion.
. tests/script.sh

# The oldest versions are translated in full, since some warnings come late, C99 by the test of symbols without the
# optimizer and with it; of the others only what the language decides.
for cc in gcc clang; do
    cxx=$(cxx_of $cc)
    for std in c11 c17; do
        if ! have $cc; then
            skip "${cc}_$std" "$cc is not installed"
            continue
        fi
        expect "${cc}_$std" $cc -std=$std $warnings -Wmissing-prototypes -DSMALL_LIBRARY -fsyntax-only tests/small.c
    done
    for std in c++11 c++17 c++20; do
        name="${cxx}_$std"
        if ! have $cxx; then
            skip "$name" "$cxx is not installed"
            continue
        fi
        how="-O2 -c -o $work/cxx.o" # g++ -Wall finds at -O2 what gcc does not
        [ $std = c++11 ] || how=-fsyntax-only
        expect "$name" $cxx -x c++ -std=$std $warnings -DSMALL_LIBRARY $how tests/small.c
    done
    have $cc || continue
    # Warnings that only an optimizer finds; the tests' own build has -O2.
    expect "${cc}_c99_optimized" $cc -std=c99 -O3 $warnings -Wmissing-prototypes -DSMALL_LIBRARY -c tests/small.c \
        -o "$work/c.o"
done

# The declarations alone, where no warning may come from either.
for cc in $(compilers); do
    cxx=$(cxx_of "$cc")
    expect "${cc}_declarations" "$cc" -std=c99 $warnings -Wmissing-prototypes -Wstrict-prototypes -fsyntax-only -x c dist.h
    have "$cxx" && expect "${cxx}_declarations" "$cxx" -std=c++11 $warnings -fsyntax-only -x c++ dist.h
done

# program NAME FILES AND FLAGS...: links with the first compiler and runs.
program() {
    program_name=$1
    shift
    if "$@" -o "$work/program" -lm >"$work/answer" 2>&1 && "$work/program" >>"$work/answer" 2>&1; then
        ok "$program_name"
    else
        not_ok "$program_name" "$(head -n 2 "$work/answer" | tr '\n' '|')"
    fi
}

# After windows.h, which defines these words.
expect words_of_windows $CC -std=c99 $warnings -Dnear= -Dfar= -Dsmall=char -Dhyper=int -Dinterface=struct \
    -DSMALL_LIBRARY -fsyntax-only tests/small.c
plain=-DDIST_NO_SIMD # it compiles three times as fast
program one_file $CC $plain -DDIST_IMPLEMENTATION tests/small.c
program included_before_and_after_the_implementation $CC $plain -DDIST_IMPLEMENTATION -DSMALL_TWICE tests/small.c
$CC $plain -DSMALL_LIBRARY -c tests/small.c -o "$work/library.o"
$CC $plain -c tests/small.c -o "$work/user.o"
$CC $plain -DSMALL_TWICE -c tests/small.c -o "$work/user_twice.o"
program two_files $CC $plain "$work/user.o" "$work/library.o"
program two_files_included_twice $CC $plain "$work/user_twice.o" "$work/library.o"
if have "$CXX"; then
    $CXX $plain -x c++ -std=c++11 -DSMALL_LIBRARY -c tests/small.c -o "$work/library_cxx.o"
    $CXX $plain -x c++ -std=c++11 -c tests/small.c -o "$work/user_cxx.o"
    program one_file_cxx $CXX $plain -x c++ -std=c++11 -DDIST_IMPLEMENTATION tests/small.c
    program cxx_user_of_c_library $CXX "$work/user_cxx.o" "$work/library.o"
    program c_user_of_cxx_library $CXX "$work/user.o" "$work/library_cxx.o"
else
    skip one_file_cxx "$CXX is not installed"
fi

# Every public struct can be zeroed by = {0} in C and C++.
{
    echo '#include <stddef.h>'
    echo '#include "../../../dist.h"'
    echo 'int main(void)'
    echo '{'
    code dist.h | sed -n '/DIST_IMPLEMENTATION/q; s/^typedef struct \(dist_[a-z_]*\) {.*/\1/p' |
        while read -r type; do echo "    $type a_$type = {0}; (void)a_$type;"; done
    echo '    return 0;'
    echo '}'
} >"$work/zero.c"
if [ "$(grep -c '= {0}' "$work/zero.c")" -lt 5 ]; then
    not_ok zeroed_structs "the public structs were not found"
else
    for cc in $(compilers); do
        cxx=$(cxx_of "$cc")
        expect "zeroed_structs_$cc" "$cc" -std=c99 -Wall -Wextra -Werror -Wno-missing-field-initializers -fsyntax-only \
            "$work/zero.c"
        have "$cxx" && expect "zeroed_structs_$cxx" "$cxx" -x c++ -std=c++11 -Wall -Wextra -Werror \
            -Wno-missing-field-initializers -fsyntax-only "$work/zero.c"
    done
fi

# Pointers of 32 bits.
echo '#include <stdlib.h>
int main(void) { return malloc(1) == NULL; }' >"$work/probe.c"
if $CC -m32 "$work/probe.c" -o "$work/probe" 2>/dev/null && "$work/probe"; then
    expect pointers_of_32_bits $CC -m32 -std=c99 $warnings -Wmissing-prototypes -DSMALL_LIBRARY -c tests/small.c -o "$work/c.o"
    program runs_with_pointers_of_32_bits $CC -m32 -DDIST_IMPLEMENTATION tests/small.c
elif have arm-linux-gnueabihf-gcc && have qemu-arm; then
    expect pointers_of_32_bits arm-linux-gnueabihf-gcc -std=c99 $warnings -Wmissing-prototypes -DSMALL_LIBRARY \
        -c tests/small.c -o "$work/c.o"
elif echo '#include <math.h>' | arm-none-eabi-gcc -mcpu=cortex-m4 -fsyntax-only -x c - 2>/dev/null; then # with a libc
    expect pointers_of_32_bits arm-none-eabi-gcc -mcpu=cortex-m4 -std=c99 $warnings -Wmissing-prototypes \
        -DSMALL_LIBRARY -c tests/small.c -o "$work/c.o"
else
    skip pointers_of_32_bits "neither -m32 nor an arm compiler with its libc works here"
fi
