#!/bin/sh
# The test programs under every compiler, option and instruction set; from the root of the repository.
#
#   sh tests/matrix.sh [quick] [ROW...]
#
# Each row ends with its own count, the last line is the sum of all. A row that this machine cannot run is one skip.
# quick: what every change must pass. With ROWs, only those.

quick=
[ "$1" = quick ] && quick=1 && shift
only=$*

sanitize="-O1 -g1 -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all -fno-omit-frame-pointer"
passed=0 failed=0 skipped=0
mkdir -p build/matrix

have() { command -v "$1" >/dev/null 2>&1; }

# wanted ROW: was it asked for?
wanted() {
    [ -z "$only" ] && return 0
    for w in $only; do [ "$w" = "$1" ] && return 0; done
    return 1
}

skip_row() {
    wanted "$1" || return 0
    echo "skip $1: $2"
    skipped=$((skipped + 1))
}

# can COMPILER FLAGS...: does a small program build, and run unless emulated?
can() {
    echo 'int main(void) { return 0; }' >build/matrix/probe.c
    "$@" build/matrix/probe.c -o build/matrix/probe >/dev/null 2>&1
}

# row NAME FOLDER COMPILER FLAGS ISA QUICK EMULATOR [TEST...]: builds what is not yet built, runs it, adds the counts.
row() {
    name=$1 folder=$2 compiler=$3 flags=$4 isa=$5 fast=$6 emulator=$7
    shift 7
    wanted "$name" || return 0
    begin=$(date +%s)
    echo "== $name: $compiler $flags${isa:+, instruction set $isa}${emulator:+, $emulator}"
    tests=
    for test in "$@"; do [ -e "tests/$test.c" ] && tests="$tests $test"; done
    targets=
    for test in $tests; do targets="$targets $folder/$test"; done
    if [ "$folder" = build ]; then # the programs of make test
        make -s -k -j2 --no-print-directory CC="$compiler" test-programs || true
    else
        mkdir -p "$folder"
        make -s -k -j2 --no-print-directory CC="$compiler" CFLAGS="$flags" TEST_FLAGS="-std=c99 -w" TEST_DIR="$folder" \
            ${targets:+TESTS="$targets"} test-programs || true
    fi
    data=${DIST_DATA:-../shared/data}
    case $compiler$emulator in # full-size networks take an emulator, or what does not optimize, too long: those tests skip
    tcc | *qemu* | *node* | *wine*) data=build/none ;;
    esac
    DIST_DATA=$data DIST_TEST_ISA=$isa DIST_TEST_QUICK=$fast sh tests/run.sh -d "$folder" -e "$emulator" $tests >build/matrix/row.log 2>&1
    sed '$d' build/matrix/row.log
    sum=$(sed -n '$s/^\([0-9]*\) passed, \([0-9]*\) failed\(, \([0-9]*\) skipped\)*$/\1 \2 \4/p' build/matrix/row.log)
    set -- ${sum:-0 1 0}
    passed=$((passed + $1)) failed=$((failed + $2)) skipped=$((skipped + ${3:-0}))
    echo "== $name: $1 passed, $2 failed, ${3:-0} skipped ($(($(date +%s) - begin)) s)"
}

# isa_row NAME FOLDER COMPILER FLAGS ISA QUICK [TEST...]: skipped where the processor's own list says so.
isa_row() {
    name=$1 folder=$2 compiler=$3 flags=$4 isa=$5 fast=$6
    shift 6
    if ! test_list=$(grep -m 1 '^flags' /proc/cpuinfo 2>/dev/null); then
        skip_row "$name" "this processor is no x86"
        return
    fi
    case $isa in
    sse2) needed="sse2" ;;
    avx2) needed="avx2 fma" ;;
    avx512) needed="avx512f avx512bw avx512dq avx512vl" ;;
    *) needed= ;;
    esac
    for feature in $needed; do
        case "$test_list " in
        *" $feature "*) ;;
        *)
            skip_row "$name" "this processor has no $isa"
            return
            ;;
        esac
    done
    row "$name" "$folder" "$compiler" "$flags" "$isa" "$fast" "" "$@"
}

if [ -n "$quick" ]; then
    cc=cc
    have gcc && cc=gcc
    if can $cc $sanitize; then
        # test_gradients takes minutes there; the backward pass is in others, random scenes among them. test_needs counts.
        slow="test_trace test_tools test_warm" # first, so that both are busy to the end
        set -- $slow $(basename -s .c tests/test_*.c | grep -v -e gradients -e needs -e trace -e tools -e warm)
        row sanitizers build/matrix/sanitizers $cc "$sanitize" "" 1 "" "$@"
    else
        skip_row sanitizers "$cc has no sanitizers here"
    fi
    # What does not optimize is slow: there the parts that depend on the compiler, inline functions and scratch.
    row O0 build/matrix/O0 $cc "-O0" "" 1 "" test_inside test_net test_context test_render test_workspace
    # What depends on the instruction set, and on the order of sums.
    set -- test_inside test_net test_color test_second test_weights test_render test_stability
    row fast_math build/matrix/fast_math $cc "-O2 -ffast-math" "" 1 "" "$@" test_trace test_gradients test_scene \
        test_camera
    isa_row scalar build $cc "-O2" scalar 1 "$@" # test_trace takes minutes there
    if grep -q '^flags.* avx512vl' /proc/cpuinfo 2>/dev/null; then
        isa_row avx2 build $cc "-O2" avx2 1 test_trace test_gradients test_warm "$@"
    else
        skip_row avx2 "make test has run with it if this processor has it"
    fi
    # Inline assembly in the other dialect.
    isa_row masm build/matrix/masm $cc "-O2 -masm=intel" "" 1 test_inside
    # As most programs are built, with multiply-adds where the compiler sees them: the same ones for few points and many.
    isa_row native_scalar build/matrix/native $cc "-O3 -march=native -ffp-contract=fast" scalar 1 test_net
else
    for cc in gcc clang; do
        if ! have $cc; then
            skip_row "$cc" "$cc is not installed"
            continue
        fi
        if can $cc $sanitize; then
            row "${cc}_sanitizers" "build/matrix/${cc}_sanitizers" $cc "$sanitize" "" 1 ""
        else
            skip_row "${cc}_sanitizers" "$cc has no sanitizers here"
        fi
        row "${cc}_O0" "build/matrix/${cc}_O0" $cc "-O0" "" 1 ""
        row "${cc}_O2" "build/matrix/${cc}_O2" $cc "-O2" "" "" ""
        for isa in scalar sse2 avx2 avx512; do
            isa_row "${cc}_$isa" "build/matrix/${cc}_O2" $cc "-O2" $isa ""
        done
        row "${cc}_O3" "build/matrix/${cc}_O3" $cc "-O3" "" "" ""
        row "${cc}_native" "build/matrix/${cc}_native" $cc "-O3 -march=native -ffp-contract=fast" "" "" ""
        isa_row "${cc}_native_scalar" "build/matrix/${cc}_native" $cc "-O3 -march=native -ffp-contract=fast" scalar ""
        isa_row "${cc}_masm" "build/matrix/${cc}_masm" $cc "-O2 -masm=intel" "" "" test_inside test_net
        row "${cc}_fast_math" "build/matrix/${cc}_fast_math" $cc "-O2 -ffast-math" "" "" ""
        isa_row "${cc}_fast_math_scalar" "build/matrix/${cc}_fast_math" $cc "-O2 -ffast-math" scalar ""
        if can $cc -fopenmp; then
            row "${cc}_openmp" "build/matrix/${cc}_openmp" $cc "-O2 -fopenmp" "" "" ""
        else
            skip_row "${cc}_openmp" "$cc has no OpenMP here"
        fi
    done
fi

if can gcc -mfpmath=387 -fexcess-precision=fast; then # registers that hold more than a float, as 32-bit x86 without SSE has
    row x87 build/matrix/x87 gcc "-O2 -mfpmath=387 -fexcess-precision=fast" "" 1 "" ${quick:+test_tools test_scene test_camera}
else
    skip_row x87 "gcc -mfpmath=387 does not work here"
fi
if can tcc; then # knows no intrinsics, no vectors and no threads: the scalar kernels
    row tcc build/matrix/tcc tcc -O2 "" 1 "" ${quick:+test_net test_files test_camera}
else
    skip_row tcc "tcc is not installed"
fi
if have aarch64-linux-gnu-gcc && have qemu-aarch64; then
    # All of it takes an emulator too long for every change.
    row aarch64 build/matrix/aarch64 aarch64-linux-gnu-gcc "-O2 -static" "" 1 qemu-aarch64 \
        ${quick:+test_inside test_outline test_camera}
    [ -n "$quick" ] || row aarch64_scalar build/matrix/aarch64 aarch64-linux-gnu-gcc "-O2 -static" scalar 1 qemu-aarch64
else
    skip_row aarch64 "aarch64-linux-gnu-gcc and qemu-aarch64 are not both installed"
fi
if [ -z "$quick" ]; then
    if have riscv64-linux-gnu-gcc && have qemu-riscv64; then
        set -- $(basename -s .c tests/test_*.c | grep -v -e trace -e warm) # which take a quarter of an hour each there
        row riscv64 build/matrix/riscv64 riscv64-linux-gnu-gcc "-O2 -static" "" 1 qemu-riscv64 "$@"
    else
        skip_row riscv64 "riscv64-linux-gnu-gcc and qemu-riscv64 are not both installed"
    fi
    if have s390x-linux-gnu-gcc && have qemu-s390x; then # the highest byte first
        set -- test_color test_files test_inside test_mesh test_net test_render
        row s390x build/matrix/s390x s390x-linux-gnu-gcc "-O2 -static" "" 1 qemu-s390x "$@"
    else
        skip_row s390x "s390x-linux-gnu-gcc and qemu-s390x are not both installed"
    fi
    wasm="--target=wasm32-wasi --sysroot=/usr -O2 -D_WASI_EMULATED_PROCESS_CLOCKS -lwasi-emulated-process-clocks"
    if have node && can clang $wasm; then
        row wasm build/matrix/wasm clang "$wasm -Wl,-z,stack-size=1048576" "" 1 "node --no-warnings tests/wasi.mjs"
    else
        skip_row wasm "clang for WebAssembly, wasi-libc and node are not all installed"
    fi
    if can gcc -fsanitize=thread && setarch -R build/matrix/probe 2>/dev/null; then # at addresses that it can follow
        row threads build/matrix/threads gcc "-O2 -g1 -fsanitize=thread" "" 1 "setarch -R" test_threads
    else
        skip_row threads "gcc -fsanitize=thread or setarch -R does not work here"
    fi
    wine=$(command -v wine64 || command -v wine || ls /usr/lib/wine/wine64 2>/dev/null)
    if have x86_64-w64-mingw32-gcc && [ -n "$wine" ]; then
        set -- $(basename -s .c tests/test_*.c)
        row windows build/matrix/windows x86_64-w64-mingw32-gcc "-O2" "" 1 "env WINEDEBUG=-all $wine" "$@"
    else
        skip_row windows "x86_64-w64-mingw32-gcc and wine are not both installed"
    fi
    echo '#include <stdlib.h>
int main(void) { return malloc(1) == NULL; }' >build/matrix/probe32.c
    if gcc -m32 build/matrix/probe32.c -o build/matrix/probe32 2>/dev/null && build/matrix/probe32; then
        row m32 build/matrix/m32 gcc "-O2 -m32" "" 1 ""
    elif have arm-linux-gnueabihf-gcc && have qemu-arm; then
        row arm build/matrix/arm arm-linux-gnueabihf-gcc "-O2 -static" "" 1 qemu-arm
    else
        skip_row pointers_of_32_bits "neither gcc -m32 nor an arm compiler works here"
    fi
fi

if [ $((passed + failed + skipped)) = 0 ]; then
    echo "not ok matrix: no row was run"
    failed=1
fi
if [ $skipped = 0 ]; then
    echo "$passed passed, $failed failed"
else
    echo "$passed passed, $failed failed, $skipped skipped"
fi
[ $failed = 0 ]
