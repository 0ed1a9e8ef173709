#!/bin/sh
# Runs the test programs, two at a time, and prints the sum as the last line. From the root of the repository.
#
#   sh tests/run.sh [-d FOLDER] [-e EMULATOR] [-s] [NAME...]
#
#   -d FOLDER     where the programs are: build
#   -e EMULATOR   put before each program
#   -s            also the script tests
#   NAME          test_net, layers, ...; all without one
#
# A program ends with a line "N passed, N failed, N skipped"; a script prints "ok NAME", "not ok NAME: why" or
# "skip NAME: why" for each test. One that does not end as it should is one more failure.

script_tests="results examples options languages symbols layers source readme"

folder=build
emulator=
scripts=
if [ "$1" = --one ]; then # one job, started by the xargs below
    folder=$2 name=$3
    log=$folder/log/$name
    begin=$(date +%s)
    DIST_TMP=${DIST_TMP:-$folder/tmp}
    export DIST_TMP
    limit=
    command -v timeout >/dev/null && limit="timeout ${DIST_TEST_SECONDS:-900}"
    case " $script_tests " in
    *" $name "*)
        $limit sh "tests/$name.sh" >"$log.log" 2>&1
        status=$?
        passed=$(grep -c '^ok ' "$log.log")
        failed=$(grep -c '^not ok ' "$log.log")
        skipped=$(grep -c '^skip ' "$log.log")
        if [ $((passed + failed + skipped)) = 0 ]; then
            echo "not ok $name: it printed no result" >>"$log.log"
            failed=1
        fi
        ;;
    *)
        program=$folder/$name
        [ -x "$program" ] || [ ! -e "$program.exe" ] || program=$program.exe
        if [ -x "$program" ]; then
            $limit $DIST_TEST_EMULATOR "$program" >"$log.log" 2>&1
            status=$?
            [ "$program" = "$folder/$name" ] || sed -i 's/\r$//' "$log.log"
            sum=$(sed -n 's/^\([0-9]*\) passed, \([0-9]*\) failed, \([0-9]*\) skipped$/\1 \2 \3/p' "$log.log" | tail -n 1)
        else
            echo "not ok $name: it did not build" >"$log.log"
            status=1 sum="0 1 0"
        fi
        if [ -z "$sum" ]; then
            echo "not ok $name: it ended with status $status and no sum" >>"$log.log"
            sum="0 1 0"
        fi
        set -- $sum
        passed=$1 failed=$2 skipped=$3
        ;;
    esac
    if [ $status != 0 ] && [ "$failed" = 0 ]; then
        echo "not ok $name: it ended with status $status" >>"$log.log"
        failed=1
    fi
    echo "$passed $failed $skipped" >"$log.sum"
    {
        grep -v -e '^ok ' -e '^[0-9]* passed, [0-9]* failed' "$log.log"
        echo "$name: $passed passed, $failed failed, $skipped skipped ($(($(date +%s) - begin)) s)"
    } >"$log.out"
    cat "$log.out"
    exit 0
fi

while getopts d:e:s option; do
    case $option in
    d) folder=$OPTARG ;;
    e) emulator=$OPTARG ;;
    s) scripts=1 ;;
    *) exit 2 ;;
    esac
done
shift $((OPTIND - 1))

names=$*
if [ -z "$names" ]; then
    # What takes longest first, so that both are busy to the end.
    [ -n "$scripts" ] && names=$script_tests
    for name in trace tools warm gradients needs; do
        [ -e "tests/test_$name.c" ] && names="$names test_$name"
    done
    for file in tests/test_*.c; do
        [ -e "$file" ] || continue
        name=${file##*/}
        case " $names " in *" ${name%.c} "*) ;; *) names="$names ${name%.c}" ;; esac
    done
fi
rm -rf "$folder/log" "$folder/tmp"
mkdir -p "$folder/log" "$folder/tmp"
DIST_TEST_EMULATOR=$emulator
export DIST_TEST_EMULATOR
for name in $names; do echo "$name"; done | xargs -P 2 -n 1 sh tests/run.sh --one "$folder"

passed=0 failed=0 skipped=0
for name in $names; do
    if [ -r "$folder/log/$name.sum" ]; then
        read -r p f s <"$folder/log/$name.sum"
    else
        p=0 f=1 s=0
    fi
    passed=$((passed + p)) failed=$((failed + f)) skipped=$((skipped + s))
done
if [ $((passed + failed + skipped)) = 0 ]; then # nothing was tested, which is no success
    echo "not ok run: no test was found"
    failed=1
fi
if [ $skipped = 0 ]; then
    echo "$passed passed, $failed failed"
else
    echo "$passed passed, $failed failed, $skipped skipped"
fi
[ $failed = 0 ]
