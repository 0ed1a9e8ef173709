/* SPDX-License-Identifier: MIT-0
   bench_needs.c - what a scene that needs less pays less for: queries, multiply-adds, seconds and bytes of memory of one
   picture and, where a gradient is wanted, its adjoint. CSV on stdout. Memory: what the context, the shape and the tape
   hold, without the caller's planes and the weights. The camera is that of the reference pictures. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "needs.h"

static const char usage[] =
    "bench_needs [options]\n"
    "  --model FILE       a decoder, or the word embedded (default)\n"
    "  --code N           its code (default 5)\n"
    "  --size N           pixels along a side (default 256)\n"
    "  --quick            96 pixels, each once\n";

static void print_need(const char *model, int code, int size, int repeats, const need *n)
{
    need_result r = need_run(model, code, size, repeats, n);
    printf("%s,%d,%llu,%llu,%llu,%.4g,%.4g,%.4f,%.0f\n", n->name, size, r.stats.rays, r.stats.queries,
           r.stats.backward_points, r.stats.operations, r.stats.operations_done, r.seconds, (double)r.bytes);
    fflush(stdout);
}

int main(int argc, char **argv)
{
    const char *model = "embedded";
    int code = 5, size = 256, repeats = 7;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--model")) {
            model = option_text(&o);
        } else if (option_is(&o, "--code")) {
            code = option_int(&o, 0, 1000);
        } else if (option_is(&o, "--size")) {
            size = option_int(&o, 8, 2048);
        } else if (option_is(&o, "--quick")) {
            option_flag(&o);
            size = 96;
            repeats = 1;
        } else {
            option_unknown(&o);
        }
    }
    printf("need,size,rays,queries,backward points,operations,operations done,seconds,bytes\n");
    for (size_t i = 0; i < NEEDS; i++) { print_need(model, code, size, repeats, &needs[i]); }
    return 0;
}
