#!/bin/sh
# What the implementation leaves in an object file: no data that can be written, no name that is not ours.
. tests/script.sh

if ! have nm; then
    skip symbols "nm is not installed"
    exit 0
fi

nm=nm
kernels='[ .](scalar|sse2|avx2|avx512|neon)(\.[0-9]+)?$'
# object NAME COMPILER FLAGS...: with all warnings, of which some come late, so that other scripts need not translate it.
object() {
    name=$1
    shift
    if ! "$@" -std=c99 $warnings -Wmissing-prototypes -DSMALL_LIBRARY -c tests/small.c -o "$work/$name.o" 2>"$work/answer"; then
        not_ok "$name" "it does not compile: $(head -n 1 "$work/answer")"
        return
    fi
    # With position independence the constant tables of the kernels' pointers stand with the data.
    case " $* " in *" -fPIC "*) ours="$kernels" ;; *) ours=gomp_critical_user_dist_run ;; esac
    $nm "$work/$name.o" | grep -E ' [bBdDCsSgG] ' | grep -v -E "$ours" >"$work/$name.data"
    expect_nothing "no_data_$name" "$work/$name.data"
    $nm -g "$work/$name.o" | grep -v ' [UwV] ' | grep -v -E ' [TtRrC] (dist_[a-z0-9_]*|\.gomp_critical_user_dist_run.*)$' \
        >"$work/$name.names"
    expect_nothing "only_dist_names_$name" "$work/$name.names"
    # What is asked of the system: mathematics, memory, strings, files.
    $nm -u "$work/$name.o" | awk '{ print $NF }' | grep -E -w \
        '_*(printf|fprintf|puts|putchar|vprintf|perror|abort|exit|_exit|raise|signal|getenv|setenv|__errno_location|assert|__assert_fail|time|clock|rand|srand|setlocale|strtod|sscanf|atof|qsort)(_chk)?' \
        >"$work/$name.calls"
    expect_nothing "no_forbidden_calls_$name" "$work/$name.calls"
}

# What optimizes with position independence, which is the default, so that all other tables must do without pointers.
for cc in $(compilers); do
    object "${cc}_O0" "$cc" -O0 -fno-pic
    object "${cc}_O2" "$cc" -O2 -fPIC -fno-math-errno
done
object openmp $CC -O0 -fno-pic -fopenmp -DDIST_NO_SIMD
if have aarch64-linux-gnu-gcc && have aarch64-linux-gnu-nm; then
    nm=aarch64-linux-gnu-nm
    object aarch64 aarch64-linux-gnu-gcc -O2 -fno-pic
    nm=nm
else
    skip aarch64 "aarch64-linux-gnu-gcc is not installed"
fi

# Declared and defined are the same.
code dist.h | sed '/DIST_IMPLEMENTATION/q' | tr '\n' ' ' | grep -o 'DIST_API [^;]*;' |
    sed -n 's/^DIST_API [^(]*[ *]\(dist_[a-z0-9_]*\)(.*/\1/p' | sort -u >"$work/declared"
first=$(compilers | head -n 1)
nm "$work/${first}_O0.o" 2>/dev/null | sed -n 's/.* T \(dist_[a-z0-9_]*\)$/\1/p' | sort -u >"$work/defined"
diff "$work/declared" "$work/defined" | grep '^[<>]' | sed 's/^</only declared:/; s/^>/only defined:/' >"$work/difference"
expect_nothing every_declaration_has_its_definition "$work/difference"
