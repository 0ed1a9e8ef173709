/* SPDX-License-Identifier: MIT-0
   blas.c - a net's wide layers through a BLAS of yours, beside the built-in kernels: the same values, and both speeds.
   make build/blas && OPENBLAS_CORETYPE=SkylakeX build/blas        (links OpenBLAS where libopenblas-dev is installed) */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"
#ifdef WITH_CBLAS
#include <cblas.h>

static void sgemm(void *user, int transpose_a, int transpose_b, int m, int n, int k, float alpha, const float *a,
                  int lda, const float *b, int ldb, float beta, float *c, int ldc)
{
    (void)user;
    cblas_sgemm(CblasRowMajor, transpose_a ? CblasTrans : CblasNoTrans, transpose_b ? CblasTrans : CblasNoTrans, m, n,
                k, alpha, a, lda, b, ldb, beta, c, ldc);
}

enum { POINTS = 12288, RUNS = 5 };
static float points[3 * POINTS], values[2][POINTS];

/* Million points a second, the best of some runs; *shape_values gets f at the points. */
static double speed(const dist_context_desc *desc, float *sdf)
{
    dist_context *ctx = dist_context_create(desc);
    dist_net_desc form = {.layers = 8, .width = 512, .skip = 4, .geometric = 1, .seed = 1};
    dist_net *net = dist_net_create(ctx, &form);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    double best = 0;
    for (int i = 0; i < RUNS; i++) {
        double start = seconds_now();
        dist_field_eval(ctx, &field, POINTS, points, sdf, NULL);
        double rate = POINTS / (seconds_now() - start) * 1e-6;
        best = rate > best ? rate : best;
    }
    check(ctx); /* a BLAS that gives wrong numbers is refused here, with a sentence */
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return best;
}
#endif

int main(int argc, char **argv)
{
    if (argc > 1) { fail("blas takes no arguments, got %s", argv[1]); }
#ifdef WITH_CBLAS
    rng r = rng_begin(1);
    for (int i = 0; i < 3 * POINTS; i++) {
        points[i] = 2.0f * rng_uniform(&r) - 1.0f;
    }
#ifdef OPENBLAS_VERSION
    openblas_set_num_threads(1); /* the library calls it from several workers at once */
    printf("OpenBLAS for %s\n", openblas_get_corename());
#endif
    dist_context_desc plain = {0};
    dist_context_desc with_blas = {.blas = {NULL, sgemm}};
    double ours = speed(&plain, values[0]);
    double theirs = speed(&with_blas, values[1]);
    double apart = 0;
    for (int i = 0; i < POINTS; i++) {
        double d = fabs((double)values[0][i] - (double)values[1][i]);
        apart = d > apart ? d : apart;
    }
    printf("8 x 512, million points a second: built-in %.4f, through the BLAS %.4f; values at most %.1e apart\n", ours,
           theirs, apart);
    return apart < 1e-4 ? 0 : 1;
#else
    puts("compiled without a BLAS: install libopenblas-dev and say make build/blas");
    return 0;
#endif
}
