#!/bin/sh
# One line that says what results belong to: processor (with family and model: a name stands for many), cores that the
# process may use, compiler, version and commit. From the root of the repository; a + behind the commit: files of the
# repository differ from it, results apart.
#
#   DIST_ORIGIN=$(sh bench/machine.sh) build/bench_grow --quick --svg bench/results/grow

name=$(sed -n 's/^model name[^:]*: *//p' /proc/cpuinfo 2>/dev/null | head -n 1)
kind=$(sed -n 's/^cpu family[^:]*: *\([0-9]*\)$/ family \1/p; s/^model[^a-z:]*: *\([0-9]*\)$/ model \1/p' \
    /proc/cpuinfo 2>/dev/null | head -n 2 | tr -d '\n')
speed=$(sed -n 's/^cpu MHz[^:]*: *\([0-9]*\).*/, \1 MHz/p' /proc/cpuinfo 2>/dev/null | head -n 1)
cores=$(nproc 2>/dev/null || getconf _NPROCESSORS_ONLN 2>/dev/null || echo unknown)
compiler=$(${CC:-cc} --version 2>/dev/null | head -n 1)
version=$(sed -n 's/^#define DIST_VERSION_M[AI][A-Z]* //p; s/^#define DIST_VERSION_PATCH //p' dist.h | paste -s -d . -)
commit=$(git rev-parse --short HEAD 2>/dev/null || echo unknown)
[ -z "$(git status --porcelain -uno -- . ':!bench/results' 2>/dev/null)" ] || commit="$commit+"
echo "${name:-$(uname -m)}$kind$speed, $cores cores; ${compiler:-unknown compiler}${CFLAGS:+ $CFLAGS};" \
    "dist.h $version, commit $commit"
