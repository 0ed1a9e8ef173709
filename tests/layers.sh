#!/bin/sh
# A section uses only sections above it: the file is cut at every marker, and what stands above must not need what stands
# below. Static functions are declared nowhere before their definition, so the compiler sees those; public ones show as
# undefined symbols.
. tests/script.sh

sections >"$work/sections"
if [ "$(wc -l <"$work/sections")" -lt 10 ]; then
    not_ok sections "fewer than ten markers found"
    exit 1
fi

# The table of contents and the headings of the interface say the same words.
sed -n '/^   Contents:/,/\*\//p' dist.h | tr '\n' ' ' | tr '@' '\n' | sed -n 's/^ \([0-9][0-9] .*[^ ]\)  *$/\1/p' |
    sed 's/ *\*\/ *$//; s/ *$//' | awk NF >"$work/contents"
sed 's/^[0-9]* //' "$work/sections" >"$work/markers"
diff "$work/contents" "$work/markers" | grep '^[<>]' | sed 's/^</only in the contents:/; s/^>/only a marker:/' >"$work/difference"
expect_nothing contents_repeat_the_markers "$work/difference"
sed -n '/End of the interface/q; s/^\/\* ---- \([0-9][0-9] .*[^ -]\) -* \*\/$/\1/p' dist.h >"$work/headings"
grep -v -x -F -f "$work/contents" "$work/headings" >"$work/difference"
expect_nothing headings_repeat_the_contents "$work/difference"

# Functions that nobody calls must stay in the object, else their calls are not seen.
keep=
echo 'int a;' >"$work/probe.c"
$CC -fkeep-static-functions -c "$work/probe.c" -o "$work/probe.o" 2>/dev/null && keep=-fkeep-static-functions

total=$(wc -l <dist.h)
while read -r line number name; do
    [ "$number" = 01 ] && continue
    above=$((line - 1))
    head -n "$above" dist.h >"$work/cut.h"
    # Close what is open: conditionals only, since braces never are at a marker in C.
    open=$(awk '/^[ \t]*#[ \t]*if/ { n++ } /^[ \t]*#[ \t]*endif/ { n-- } END { print n + 0 }' "$work/cut.h")
    while [ "$open" -gt 0 ]; do
        echo '#endif' >>"$work/cut.h"
        open=$((open - 1))
    done
    test="sections_above_$number"
    # The kernels are seen once, with the section after them; without them it compiles three times as fast.
    plain=-DDIST_NO_SIMD
    [ "$number" = 04 ] && plain=
    if ! $CC -std=c99 -O0 $plain $keep -Werror=implicit-function-declaration -Wno-unused-function -DDIST_IMPLEMENTATION -x c \
        -c "$work/cut.h" -o "$work/cut.o" 2>"$work/answer"; then
        not_ok "$test" "they do not compile alone: $(grep error "$work/answer" | head -n 1)"
        continue
    fi
    nm -u "$work/cut.o" | grep -E ' disti?_' >"$work/undefined"
    expect_nothing "${test}_stand_alone" "$work/undefined"
done <"$work/sections"

# knows_not NUMBERS PATTERN NAME: the code of these sections does not mention the pattern.
code dist.h >"$work/code"
knows_not() {
    : >"$work/found"
    for number in $1; do
        from=$(awk -v n="$number" '$2 == n { print $1 }' "$work/sections")
        to=$(awk -v n="$number" '$2 > n { print $1 - 1; exit }' "$work/sections")
        [ -n "$from" ] || { echo "section $number is missing" >>"$work/found"; continue; }
        awk -v from="$from" -v to="${to:-$total}" 'NR >= from && NR <= to { print NR ": " $0 }' "$work/code" |
            grep -E "$2" >>"$work/found"
    done
    expect_nothing "$3" "$work/found"
}
knows_not "07 08" '(disti?|DISTI?)_(net|shape|NET|SHAPE)' tracer_and_renderer_know_no_network
knows_not 05 'disti?_(camera|tape|render|images|trace)' network_knows_no_camera
knows_not "09 10" 'disti?_(context|field|net|shape|render|trace|tape|run|alloc)' losses_and_optimizer_know_only_arrays
knows_not 10 'disti?_camera' optimizer_knows_no_camera
