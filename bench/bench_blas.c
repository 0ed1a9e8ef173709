/* SPDX-License-Identifier: MIT-0
   bench_blas.c - the built-in kernels, the BLAS hook, a BLAS by itself and oneDNN on the same chains of layers, one
   thread, against the multiply-add peak of the same run. CSV on stdout. `make build/bench_blas` links what is installed
   (libopenblas-dev, libdnnl-dev); set OPENBLAS_CORETYPE=SkylakeX where OpenBLAS does not know the processor.

   dist: dist_field_eval of a whole net, no BLAS. hook: the same with the BLAS as dist_context_desc.blas, which by
   default gets layers of 192 units and more; of narrower ones hook is dist again. kernels, blas, onednn: the square
   layers alone, each as y = relu(W x + b), the libraries at the batch that suits them best.
   hook and blas take turns, and their times are medians: stderr has the rate of one over that of the other, the
   median, the first and the last quarter of all turns. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "peak.h"
#ifdef WITH_CBLAS
#include <cblas.h>
#endif
#ifdef WITH_DNNL
#include <dnnl.h>
#include <omp.h>
#endif

static const char usage[] =
    "bench_blas [options]\n"
    "  --case NAME        8x512, 8x256, 8x128, 4x64 or 8x32: only this one\n"
    "  --repetitions N    of each measurement, of which the fastest counts (default 15)\n"
    "  --quick            8x512 and 8x128, short\n";

typedef struct net_case {
    const char *name;
    int layers, width;
} net_case;

static const net_case cases[] = {{"8x512", 8, 512}, {"8x256", 8, 256}, {"8x128", 8, 128}, {"4x64", 4, 64},
                                 {"8x32", 8, 32}};

enum { CASES = sizeof cases / sizeof cases[0], BATCHES = 7, LARGEST = 3072, WIDEST = 512, LAYERS = 8 };
static const int batches[BATCHES] = {48, 96, 192, 384, 768, 1536, LARGEST};

/* `layers` - 1 square layers one after the other: what a net of that many hidden layers costs behind its first. */
typedef struct chain {
    int layers, width, batch;
    float *weights[LAYERS], *bias, *x, *y;
    void (*run_fn)(struct chain *c);
    void *user;
} chain;

/* By the kernel of section 03, with the masks that the reverse pass needs. */
static void run_kernels(chain *c)
{
    disti_kernels kernels = disti_kernels_for(disti_cpu_best());
    uint64_t mask[WIDEST];
    disti_gemm g;
    memset(&g, 0, sizeof g);
    g.bias = c->bias;
    g.rows = c->width;
    g.out = c->width;
    g.columns = DISTI_BLOCK;
    g.mask = mask;
    for (int i = 0; i < c->batch / DISTI_BLOCK; i++) {
        float *x = c->x + (size_t)i * DISTI_BLOCK * (size_t)c->width;
        float *y = c->y;
        for (int l = 0; l + 1 < c->layers; l++) {
            g.weights = c->weights[l];
            g.x = x;
            g.y = y;
            kernels.gemm(&g);
            float *other = x;
            x = y;
            y = other;
        }
    }
}

static double chain_operations(const chain *c)
{
    return (double)(c->layers - 1) * c->width * c->width;
}

#ifdef WITH_CBLAS
static void run_cblas(chain *c)
{
    size_t n = (size_t)c->batch, width = (size_t)c->width;
    float *x = c->x;
    float *y = c->y;
    for (int l = 0; l + 1 < c->layers; l++) {
        cblas_sgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, c->width, c->batch, c->width, 1.0f, c->weights[l],
                    c->width, x, c->batch, 0.0f, y, c->batch);
        for (size_t o = 0; o < width; o++) {
            for (size_t i = 0; i < n; i += 48) {
                float *row = y + o * n + i;
                for (int k = 0; k < 48; k++) {
                    row[k] = row[k] + c->bias[o] > 0.0f ? row[k] + c->bias[o] : 0.0f;
                }
            }
        }
        float *other = x;
        x = y;
        y = other;
    }
}

static void hook_sgemm(void *user, int ta, int tb, int m, int n, int k, float alpha, const float *a, int lda,
                       const float *b, int ldb, float beta, float *c, int ldc)
{
    (void)user;
    cblas_sgemm(CblasRowMajor, ta ? CblasTrans : CblasNoTrans, tb ? CblasTrans : CblasNoTrans, m, n, k, alpha, a, lda,
                b, ldb, beta, c, ldc);
}
#endif

#ifdef WITH_DNNL
/* Inner products with bias and ReLU as post-operation, weights in the layout that oneDNN asks for. */
typedef struct dnnl_chain {
    dnnl_engine_t engine;
    dnnl_stream_t stream;
    dnnl_primitive_t layer;
    dnnl_memory_t weights[LAYERS], bias, x, y;
} dnnl_chain;

static void dnnl_try(dnnl_status_t status)
{
    if (status != dnnl_success) { fail("oneDNN: status %.0f", (double)status); }
}

static void run_dnnl(chain *c)
{
    dnnl_chain *d = (dnnl_chain *)c->user;
    dnnl_memory_t x = d->x;
    dnnl_memory_t y = d->y;
    for (int l = 0; l + 1 < c->layers; l++) {
        dnnl_exec_arg_t arguments[4] = {
            {DNNL_ARG_SRC, x}, {DNNL_ARG_WEIGHTS, d->weights[l]}, {DNNL_ARG_BIAS, d->bias}, {DNNL_ARG_DST, y}};
        dnnl_try(dnnl_primitive_execute(d->layer, d->stream, 4, arguments));
        dnnl_memory_t other = x;
        x = y;
        y = other;
    }
    dnnl_try(dnnl_stream_wait(d->stream));
}

static void dnnl_begin(chain *c, dnnl_chain *d)
{
    dnnl_memory_desc_t data;
    dnnl_memory_desc_t plain;
    dnnl_memory_desc_t any;
    dnnl_memory_desc_t bias;
    dnnl_inner_product_desc_t desc;
    dnnl_primitive_desc_t pd;
    dnnl_primitive_attr_t attributes;
    dnnl_post_ops_t relu;
    dnnl_dims_t batch = {c->batch, c->width};
    dnnl_dims_t square = {c->width, c->width};
    dnnl_dims_t row = {c->width};
    dnnl_try(dnnl_engine_create(&d->engine, dnnl_cpu, 0));
    dnnl_try(dnnl_stream_create(&d->stream, d->engine, dnnl_stream_default_flags));
    dnnl_try(dnnl_memory_desc_init_by_tag(&data, 2, batch, dnnl_f32, dnnl_ab));
    dnnl_try(dnnl_memory_desc_init_by_tag(&plain, 2, square, dnnl_f32, dnnl_ab));
    dnnl_try(dnnl_memory_desc_init_by_tag(&any, 2, square, dnnl_f32, dnnl_format_tag_any));
    dnnl_try(dnnl_memory_desc_init_by_tag(&bias, 1, row, dnnl_f32, dnnl_a));
    dnnl_try(dnnl_inner_product_forward_desc_init(&desc, dnnl_forward_inference, &data, &any, &bias, &data));
    dnnl_try(dnnl_primitive_attr_create(&attributes));
    dnnl_try(dnnl_post_ops_create(&relu));
    dnnl_try(dnnl_post_ops_append_eltwise(relu, 1.0f, dnnl_eltwise_relu, 0.0f, 0.0f));
    dnnl_try(dnnl_primitive_attr_set_post_ops(attributes, relu));
    dnnl_try(dnnl_primitive_desc_create(&pd, &desc, attributes, d->engine, NULL));
    dnnl_try(dnnl_primitive_create(&d->layer, pd));
    const dnnl_memory_desc_t *packed = dnnl_primitive_desc_query_md(pd, dnnl_query_weights_md, 0);
    for (int l = 0; l + 1 < c->layers; l++) {
        dnnl_memory_t from;
        dnnl_primitive_desc_t reorder_pd;
        dnnl_primitive_t reorder;
        dnnl_try(dnnl_memory_create(&from, &plain, d->engine, c->weights[l]));
        dnnl_try(dnnl_memory_create(&d->weights[l], packed, d->engine, DNNL_MEMORY_ALLOCATE));
        dnnl_try(dnnl_reorder_primitive_desc_create(&reorder_pd, &plain, d->engine, packed, d->engine, NULL));
        dnnl_try(dnnl_primitive_create(&reorder, reorder_pd));
        dnnl_exec_arg_t arguments[2] = {{DNNL_ARG_FROM, from}, {DNNL_ARG_TO, d->weights[l]}};
        dnnl_try(dnnl_primitive_execute(reorder, d->stream, 2, arguments));
        dnnl_try(dnnl_stream_wait(d->stream));
        dnnl_primitive_destroy(reorder);
        dnnl_primitive_desc_destroy(reorder_pd);
        dnnl_memory_destroy(from);
    }
    dnnl_try(dnnl_memory_create(&d->bias, &bias, d->engine, c->bias));
    dnnl_try(dnnl_memory_create(&d->x, &data, d->engine, c->x));
    dnnl_try(dnnl_memory_create(&d->y, &data, d->engine, c->y));
    dnnl_post_ops_destroy(relu);
    dnnl_primitive_attr_destroy(attributes);
    dnnl_primitive_desc_destroy(pd);
}

static void dnnl_end(chain *c, dnnl_chain *d)
{
    for (int l = 0; l + 1 < c->layers; l++) {
        dnnl_memory_destroy(d->weights[l]);
    }
    dnnl_memory_destroy(d->bias);
    dnnl_memory_destroy(d->x);
    dnnl_memory_destroy(d->y);
    dnnl_primitive_destroy(d->layer);
    dnnl_stream_destroy(d->stream);
    dnnl_engine_destroy(d->engine);
}
#endif

typedef struct settings {
    const char *only_case;
    int repetitions, quick;
} settings;

static void print_row(const char *name, const char *library, int batch, double seconds, double operations, double peak)
{
    double rate = batch / seconds;
    printf("%s,%s,1,%d,%.6f,%.0f,%.1f,%.1f,%.3f,dense\n", name, library, batch, seconds, rate, 2e-9 * operations * rate,
           peak, 2e-9 * operations * rate / peak);
    fflush(stdout);
}

static double work_seconds(dist_context *ctx, void (*work_fn)(void *work), void *work, const settings *s, double *peak)
{
    double best = 1e30;
    double taken;
    double length = s->quick ? 0.002 : 0.005;
    work_fn(work);
    double start = now_of(ctx);
    work_fn(work);
    int passes = (int)(length / (now_of(ctx) - start + 1e-7)) + 1;
    for (int r = 0; r < s->repetitions; r++) {
        double once = peak_once(ctx, 100000, &taken);
        *peak = once > *peak ? once : *peak;
        start = now_of(ctx);
        for (int i = 0; i < passes; i++) {
            work_fn(work);
        }
        double seconds = (now_of(ctx) - start) / passes;
        best = seconds < best ? seconds : best;
    }
    return best;
}

typedef struct eval_work {
    dist_context *ctx;
    dist_field field;
    const float *points;
    float *sdf;
} eval_work;

static void eval_once(void *work)
{
    const eval_work *w = (const eval_work *)work;
    dist_field_eval(w->ctx, &w->field, LARGEST, w->points, w->sdf, NULL);
}

static void chain_once(void *work)
{
    chain *c = (chain *)work;
    c->run_fn(c);
}

/* The net by dist_field_eval, every unit alive; with_hook: through the BLAS. Counts all its multiply-adds. */
typedef struct dist_work {
    eval_work w;
    dist_net *net;
    dist_shape *shape;
    float *points;
    double operations;
} dist_work;

static void dist_begin(dist_work *d, const net_case *c, int with_hook)
{
    dist_context_desc context;
    dist_net_desc desc;
    memset(&context, 0, sizeof context);
    memset(&desc, 0, sizeof desc);
    context.workers = 1;
#ifdef WITH_CBLAS
    if (with_hook) { context.blas.sgemm_fn = hook_sgemm; }
#else
    (void)with_hook;
#endif
    d->w.ctx = dist_context_create(&context);
    desc.layers = c->layers;
    desc.width = c->width;
    desc.seed = 1;
    d->net = dist_net_create(d->w.ctx, &desc);
    check(d->w.ctx);
    make_alive(d->w.ctx, d->net);
    d->shape = dist_shape_create(d->w.ctx, d->net, NULL);
    check(d->w.ctx);
    d->w.field = dist_shape_field(d->shape);
    d->points = take_floats((size_t)3 * LARGEST);
    rng r = rng_begin(1);
    for (size_t i = 0; i < (size_t)3 * LARGEST; i++) {
        d->points[i] = 1.1f * rng_uniform(&r) - 0.55f;
    }
    d->w.points = d->points;
    d->w.sdf = take_floats(LARGEST);
    d->operations = (double)dist_net_operations(d->net, 1);
}

static void dist_end(dist_work *d)
{
    check(d->w.ctx);
    free(d->points);
    free(d->w.sdf);
    dist_shape_destroy(d->shape);
    dist_net_destroy(d->net);
    dist_context_destroy(d->w.ctx);
}

static void measure_dist(const settings *s, const net_case *c, double *peak)
{
    dist_work d;
    dist_begin(&d, c, 0);
    double seconds = work_seconds(d.w.ctx, eval_once, &d.w, s, peak);
    print_row(c->name, "dist", LARGEST, seconds, d.operations, *peak);
    dist_end(&d);
}

#ifdef WITH_CBLAS
/* The net through the hook and the chain by the BLAS itself, in turn. */
static void measure_hook(const settings *s, const net_case *k, chain *c, double *peak)
{
    enum { MOST = 1001 };
    static double times[2][MOST], ratio[MOST];
    dist_work d;
    dist_begin(&d, k, 1);
    eval_once(&d.w);
    chain_once(c);
    int passes = LARGEST / c->batch, turns = s->quick ? 5 : s->repetitions;
    for (int r = 0; r < turns; r++) {
        double start = now_of(d.w.ctx);
        eval_once(&d.w);
        double middle = now_of(d.w.ctx);
        for (int i = 0; i < passes; i++) {
            chain_once(c);
        }
        times[0][r] = middle - start;
        times[1][r] = now_of(d.w.ctx) - middle;
        ratio[r] = times[1][r] / times[0][r] * d.operations / chain_operations(c);
    }
    print_row(k->name, "hook", LARGEST, median((size_t)turns, times[0]), d.operations, *peak);
    print_row(k->name, "blas", c->batch, median((size_t)turns, times[1]) / passes, chain_operations(c), *peak);
    double half = median((size_t)turns, ratio); /* sorts */
    fprintf(stderr, "%s: the hook has %.3f times the rate of the BLAS alone (%.3f to %.3f)\n", k->name, half,
            ratio[turns / 4], ratio[turns - 1 - turns / 4]);
    dist_end(&d);
}
#endif

enum { KERNELS, CBLAS, DNNL };

static void measure_chain(const settings *s, const net_case *k, int library, double *peak)
{
    dist_context_desc one;
    memset(&one, 0, sizeof one);
    one.workers = 1;
    dist_context *ctx = dist_context_create(&one);
    chain c;
    double best = 1e30;
    int best_batch = 0;
    memset(&c, 0, sizeof c);
    c.layers = k->layers;
    c.width = k->width;
    size_t size = (size_t)k->width * (size_t)k->width;
    for (int l = 0; l < k->layers; l++) {
        c.weights[l] = take_floats(size);
        for (size_t i = 0; i < size; i++) {
            c.weights[l][i] = 0.4f / (float)k->width * ((float)(i * 7 % 11) / 5.0f - 1.0f);
        }
    }
    c.bias = take_floats(WIDEST);
    c.x = take_floats((size_t)LARGEST * (size_t)k->width);
    c.y = take_floats((size_t)LARGEST * (size_t)k->width);
    for (int i = 0; i < WIDEST; i++) {
        c.bias[i] = 1.0f;
    }
    c.run_fn = run_kernels;
#ifdef WITH_CBLAS
    if (library == CBLAS) { c.run_fn = run_cblas; }
#endif
#ifdef WITH_DNNL
    dnnl_chain d;
    c.user = &d;
    if (library == DNNL) { c.run_fn = run_dnnl; }
#endif
    for (int i = library == KERNELS ? BATCHES - 1 : 0; i < BATCHES; i++) {
        c.batch = batches[i];
#ifdef WITH_DNNL
        if (library == DNNL) { dnnl_begin(&c, &d); }
#endif
        double each = work_seconds(ctx, chain_once, &c, s, peak) / c.batch;
        if (each < best) { best_batch = c.batch; }
        best = each < best ? each : best;
#ifdef WITH_DNNL
        if (library == DNNL) { dnnl_end(&c, &d); }
#endif
    }
    static const char *const names[] = {"kernels", "blas", "onednn"};
    c.batch = best_batch;
#ifdef WITH_CBLAS
    if (library == CBLAS && k->width >= 128) measure_hook(s, k, &c, peak);
    else
#endif
        print_row(k->name, names[library], best_batch, best * best_batch, chain_operations(&c), *peak);
    for (int l = 0; l < k->layers; l++) {
        free(c.weights[l]);
    }
    free(c.bias);
    free(c.x);
    free(c.y);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    settings s = {NULL, 15, 0};
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--case")) {
            s.only_case = option_text(&o);
        } else if (option_is(&o, "--repetitions")) {
            s.repetitions = option_int(&o, 1, 1001);
        } else if (option_is(&o, "--quick")) {
            s.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
#ifdef WITH_CBLAS
#ifdef OPENBLAS_VERSION
    openblas_set_num_threads(1);
    fprintf(stderr, "OpenBLAS for %s\n", openblas_get_corename());
#endif
#else
    fputs("compiled without a BLAS: make build/bench_blas where libopenblas-dev is installed\n", stderr);
#endif
#ifdef WITH_DNNL
    omp_set_num_threads(1);
#else
    fputs("compiled without oneDNN: make build/bench_blas where libdnnl-dev is installed\n", stderr);
#endif
    puts("case,library,threads,batch,seconds,queries_per_s,gflops,peak_gflops,share,mode");
    int found = 0;
    for (int i = 0; i < CASES; i++) {
        const net_case *c = &cases[i];
        double peak = 0;
        if (s.only_case && strcmp(s.only_case, c->name) != 0) { continue; }
        if (s.quick && !s.only_case && i != 0 && i != 2) { continue; }
        found = 1;
        measure_dist(&s, c, &peak);
        measure_chain(&s, c, KERNELS, &peak);
#ifdef WITH_CBLAS
        measure_chain(&s, c, CBLAS, &peak);
#endif
#ifdef WITH_DNNL
        measure_chain(&s, c, DNNL, &peak);
#endif
    }
    check_found("--case", s.only_case, found);
    return 0;
}
