#!/bin/sh
# Rules about the text of dist.h.
. tests/script.sh

sections >"$work/sections"
code dist.h >"$work/code"
start_of() { awk -v n="$1" '$2 == n { print $1 }' "$work/sections"; }

grep -n '[^ -~]' dist.h >"$work/found"
expect_nothing only_printable_ascii "$work/found"
awk 'length($0) > 120 { print FILENAME ":" FNR ": " length($0) " columns" }' dist.h tests/*.h tests/*.c >"$work/found"
expect_nothing lines_of_at_most_120_columns "$work/found"
grep -n ' $' dist.h >"$work/found"
expect_nothing no_space_at_the_end_of_a_line "$work/found"

first=$(grep -n -m 1 -E '^(typedef|enum|struct|DIST_API)' "$work/code" | cut -d : -f 1)
[ "${first:-999}" -le 150 ] && ok first_declaration_within_150_lines ||
    not_ok first_declaration_within_150_lines "it stands in line $first"
[ "$(head -n 1 dist.h)" = "/* SPDX-License-Identifier: MIT-0" ] && ok license_line_first ||
    not_ok license_line_first "line 1 is another"
[ "$(grep -c 'End of the interface. You can stop reading here.' dist.h)" = 1 ] && ok one_ruler_ends_the_interface ||
    not_ok one_ruler_ends_the_interface "found another number of them"

# Names with a leading or a double underscore belong to the compiler; what we may use of its names is listed.
# What stands after ## is the end of a name.
sed 's/##[ ]*_/##x_/g' "$work/code" | grep -n -o -E '[A-Za-z0-9_]+' | grep -E ':(_|[A-Za-z0-9_]*__)' | grep -v -E ':(__cplusplus|_OPENMP|_MSC_VER|_M_[A-Z0-9]+|_WIN(32|64)|__(GNUC|GNUC_MINOR|clang|clang_major|x86_64|i386|aarch64|ARM_NEON|SSE2|OPTIMIZE|FINITE_MATH_ONLY|FLT_EVAL_METHOD|attribute|restrict|asm|has_builtin|has_include|has_attribute|BYTE_ORDER|ORDER_LITTLE_ENDIAN|ORDER_BIG_ENDIAN)(__)?|__builtin_[a-z0-9_]+|_mm(256|512)?_[a-z0-9_]*|_MM_[A-Z_0-9]+|_CMP_[A-Z_]+|__m(128|256|512)[id]?|__mmask(8|16|32|64)|__cpuid(ex|_count|_max)?|_xgetbv|__volatile__|__declspec|__prefetch|__restrict|__inline|_ReadWriteBarrier|__unused__)$' \
    >"$work/found"
grep -n -E '^[ ]*#[ ]*(define|undef) *(_|[A-Za-z0-9_]*__)' "$work/code" >>"$work/found"
expect_nothing no_reserved_names "$work/found"

grep -n -w -E '(v?[fs]?n?printf|puts|putchar|fputs|perror|abort|_?exit|quick_exit|errno|getenv|setenv|assert|signal|raise|setjmp|longjmp)' "$work/code" |
    grep -v -E '(->|\.)(exit|signal)' >"$work/found"
expect_nothing no_printing_ending_or_environment "$work/found"

# Files only where stdio may be left out; the allocator only behind its two functions.
grep -n -w -E '(malloc|calloc|realloc|free|aligned_alloc|posix_memalign|alloca)' "$work/code" >"$work/calls"
sed -n '/static void \*disti_libc_alloc/,/^#endif/=' dist.h >"$work/lines"
: >"$work/found"
while IFS=: read -r line text; do
    grep -q -x "$line" "$work/lines" || echo "$line:$text" >>"$work/found"
done <"$work/calls"
expect_nothing libc_allocator_only_in_the_default_hook "$work/found"

grep -n -E '^[ ]*#[ ]*include' "$work/code" | grep -v -E '<(stddef|fenv|math|stdint|stdlib|string|stdio|([a-z0-9]*)intrin|arm_neon)\.h>' \
    >"$work/found"
expect_nothing only_the_allowed_includes "$work/found"

grep -n -E '(#[ ]*pragma|_Pragma)' "$work/code" >"$work/pragmas"
grep -v -E 'pragma omp' "$work/pragmas" >"$work/found"
expect_nothing no_pragma_but_openmp "$work/found"
two=$(start_of 02) three=$(start_of 03) four=$(start_of 04)
awk -F : -v from="$two" -v to="$three" '$1 < from || $1 > to' "$work/pragmas" >"$work/found"
expect_nothing openmp_only_in_section_02 "$work/found"
count=$(grep -c 'omp parallel' "$work/pragmas")
[ "$count" -le 2 ] && ok at_most_two_parallel_regions || not_ok at_most_two_parallel_regions "there are $count"

grep -n -E '(__m(128|256|512)|__mmask|_mm[0-9]*_[a-z]|float(32|64)x[0-9]_t|uint(8|16|32|64)x[0-9]+_t|\bv[a-z0-9]+q_(f|u|s)(8|16|32|64)\b)' \
    "$work/code" | awk -F : -v from="$two" -v to="$four" '$1 < from || $1 >= to' >"$work/found"
expect_nothing intrinsics_only_in_sections_02_and_03 "$work/found"

grep -n -E '\b(colour|neighbour|normalis|initialis|optimis|centre|behaviour|grey|licence|artefact)' -i dist.h >"$work/found"
expect_nothing american_spelling "$work/found"
grep -n -E '\b(TODO|FIXME|XXX|HACK)\b' dist.h >"$work/found"
expect_nothing no_loose_ends "$work/found"

# The version, everywhere the same.
number() { sed -n "s/^#define DIST_VERSION_$1 \([0-9]*\)\$/\1/p" dist.h; }
macros="$(number MAJOR).$(number MINOR).$(number PATCH)"
changes=$(sed -n 's/^## \([0-9.]*\).*/\1/p' CHANGELOG.md | head -n 1)
[ "$macros" = "$changes" ] && ok version_of_the_change_log || not_ok version_of_the_change_log "$changes, the macros say $macros"
printf '#define DIST_IMPLEMENTATION\n#include "../../../dist.h"\n#include <stdio.h>\nint main(void) { return puts(dist_version()) < 0; }\n' \
    >"$work/version.c"
said=$($CC "$work/version.c" -o "$work/version" -lm 2>/dev/null && "$work/version")
[ "$macros" = "$said" ] && ok version_of_dist_version || not_ok version_of_dist_version "$said, the macros say $macros"
if have git && tag=$(git describe --tags --exact-match 2>/dev/null); then
    [ "v$macros" = "$tag" ] && ok version_of_the_tag || not_ok version_of_the_tag "$tag, the macros say $macros"
fi
