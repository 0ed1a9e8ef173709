/* SPDX-License-Identifier: MIT-0
   test_inside.c - what no declaration shows, in one translation: files, kernels, 16 bits, single steps */
#define TEST_INSIDE
#include "test.h"

#include "inside_archive.h"
#include "inside_kernels.h"
#include "inside_half.h"
#include "inside_parts.h"

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    run_archive();
    run_kernels();
    run_half();
    run_parts();
    return test_report();
}
