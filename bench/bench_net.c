/* SPDX-License-Identifier: MIT-0
   bench_net.c - how fast networks are evaluated and differentiated, against the multiply-add peak of the same
   instruction set measured in the same seconds. CSV on stdout.

   mode dense: every unit alive, so every multiply-add is done. dead: a real decoder at its own surface, where most
   units are zero and left out; its rate counts what a dense net would do. backward: value and gradient at the point;
   backward_code: that and the code's gradient; weights: the gradients of a loss on f for all weights and the code;
   eikonal: those of (|grad f| - 1)^2. Beside a real decoder are all_alive, all_alive_backward and
   all_alive_backward_code: a net of the same layers without a dead unit at the same points; of_alive is a mode's time
   over that net's, reverse_of_alive the same of what backward takes more than the forward pass. f16, bf16, and
   f16_dead, bf16_dead: the hidden layers in 16 bits, where the processor has the instructions, against the peak of
   those; max_error and rms_error are against f32. gflops counts the forward pass alone in all modes; of_forward is the
   time in f32 forward passes; executed is the share of the forward multiply-adds that was done. speedup, in f32 rows
   of several threads: their rate over that of one thread, and peak_speedup the same of the peak loop, which says what
   the machine gives; one thread and all of them take turns, by the clock, the fastest of each, since what else runs
   costs several threads more than one; 0 in other rows. Of the narrow nets 12288 points are asked for at a time, so
   that a pass is long beside what it takes to begin with several threads and end. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "peak.h"

static const char usage[] =
    "bench_net [options]\n"
    "  --case NAME        8x512, 8x256, 8x128, 4x64 or 8x32: only this one\n"
    "  --isa NAME         scalar, sse2, avx2, avx512 or neon: only this one\n"
    "  --threads N        besides 1, where the build has OpenMP (default 2)\n"
    "  --model FILE       a decoder at its own surface instead of the random nets; or the word embedded\n"
    "  --code N           which of its codes (default 0)\n"
    "  --activation NAME  of the random nets: relu (default), elu, softplus, sine or tanh\n"
    "  --points N         at a time (default 3072, of the narrow nets 12288, with --quick 768, of scalar kernels 192,\n"
    "                     which are the most)\n"
    "  --repetitions N    of each measurement (default 9)\n"
    "  --best             the fastest of them, not the median: for a machine that others use too\n"
    "  --quick            the two extreme cases, one thread, short\n";

typedef struct net_case {
    const char *name;
    int layers, width, skip, code_size;
} net_case;

static const net_case cases[] = {
    {"8x512", 8, 512, 4, 256}, {"8x256", 8, 256, 4, 64}, {"8x128", 8, 128, 4, 64},
    {"4x64", 4, 64, 0, 16},    {"8x32", 8, 32, 0, 16},
};

enum { CASES = sizeof cases / sizeof cases[0], REPETITIONS_MAX = 1001 };
enum {
    FORWARD,
    BACKWARD,
    BACKWARD_CODE,
    WEIGHTS,
    EIKONAL,
    ALIVE,
    ALIVE_BACKWARD,
    ALIVE_BACKWARD_CODE,
    F16,
    BF16,
    MODES
};
static const char *const activations[] = {"relu", "elu", "softplus", "sine", "tanh", NULL}; /* DIST_ACTIVATION_* */

typedef struct settings {
    const char *only_case, *only_isa, *model;
    int code, threads, points, repetitions, best, quick, activation;
} settings;

/* ---- what is measured -------------------------------------------------------------------------------------------- */

typedef struct work {
    dist_context *ctx;
    int wall; /* by the clock, also with one thread */
    dist_field field, alive, half[2]; /* alive: without dead units; half: in f16 and bf16; without eval_fn: not here */
    size_t batch;
    const float *points;
    float *sdf, *other_sdf, *gradient, *d_sdf, *d_code, *d_weights; /* sdf: of f32 forward */
    double operations;
} work;

static void seed_ones(void *user, size_t first, size_t count, const float *sdf, const float *gradient, float *d_sdf)
{
    (void)user, (void)first, (void)sdf, (void)gradient;
    for (size_t i = 0; i < count; i++) {
        d_sdf[i] = 1.0f;
    }
}

static void work_once(const work *w, int mode)
{
    const dist_field *field = mode >= F16 ? &w->half[mode - F16] : mode >= ALIVE ? &w->alive : &w->field;
    float *sdf = mode == FORWARD ? w->sdf : w->other_sdf;
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = w->d_code;
    switch (mode) {
    case BACKWARD:
    case ALIVE_BACKWARD: dist_field_eval(w->ctx, field, w->batch, w->points, sdf, w->gradient); break;
    case BACKWARD_CODE:
    case ALIVE_BACKWARD_CODE:
        dist_field_backward(w->ctx, field, w->batch, w->points, w->d_sdf, seed_ones, NULL, w->gradient, &grads);
        break;
    case WEIGHTS:
        grads.weights = w->d_weights;
        dist_field_backward(w->ctx, field, w->batch, w->points, w->d_sdf, seed_ones, NULL, NULL, &grads);
        break;
    case EIKONAL: {
        float loss = 0;
        grads.weights = w->d_weights;
        dist_field_eikonal(w->ctx, field, w->batch, w->points, 1.0f, &loss, &grads);
        break;
    }
    default: dist_field_eval(w->ctx, field, w->batch, w->points, sdf, NULL);
    }
}

/* Seconds of one pass, the mean of several. */
static double work_time(const work *w, int mode, int passes)
{
    double start = w->wall ? seconds_now() : now_of(w->ctx);
    for (int i = 0; i < passes; i++) {
        work_once(w, mode);
    }
    return ((w->wall ? seconds_now() : now_of(w->ctx)) - start) / passes;
}

/* GFLOP/s of the peak loop in f32, by the clock. */
static double peak_wall(const work *w, long loops)
{
    double taken = 0;
    double start = seconds_now();
    double rate = peak_once(w->ctx, loops, &taken);
    return rate * taken / (seconds_now() - start);
}

/* Share of the multiply-adds that were not left out as dead units, of one forward pass over the batch. */
static double executed_share(const work *w, int mode)
{
    double dense = 0;
    double done = 0;
    int workers = dist_context_workers(w->ctx);
    for (int i = 0; i < workers; i++) {
        memset(disti_counter_of(w->ctx, i), 0, sizeof(disti_counter));
    }
    work_once(w, mode);
    for (int i = 0; i < workers; i++) {
        dense += disti_counter_of(w->ctx, i)->dense;
        done += disti_counter_of(w->ctx, i)->done;
    }
    return dense > 0 ? done / dense : 1;
}

static int has_mode(const work *w, int mode)
{
    if (mode == BACKWARD_CODE) { return w->d_code != NULL; }
    if (mode == ALIVE_BACKWARD_CODE) { return w->d_code && w->alive.eval_fn; }
    return mode < ALIVE || (mode < F16 ? w->alive : w->half[mode - F16]).eval_fn;
}

/* Measures the modes of one net in turn with the peaks of their instructions, several times, and prints a row each.
   one: the same with one thread, or NULL */
static void measure(const settings *s, const char *name, const work *w, const work *one, int dead)
{
    static const char *const names[2][MODES] = {
        {"dense", "backward", "backward_code", "weights", "eikonal", "", "", "", "f16", "bf16"},
        {"dead", "backward", "backward_code", "weights", "eikonal", "all_alive", "all_alive_backward",
         "all_alive_backward_code", "f16_dead", "bf16_dead"}};
    static double peaks[3][REPETITIONS_MAX], times[MODES][REPETITIONS_MAX]; /* peaks: f32, f16, bf16 */
    double fastest[2][MODES] = {{0}}; /* passes a second, of one thread and of all */
    double highest[2] = {0, 0};
    static const int halves[3] = {DIST_HALF_OFF, DIST_HALF_F16, DIST_HALF_BF16};
    double length = s->quick ? 0.004 : 0.02;
    int passes[MODES];
    size_t n = (size_t)s->repetitions;
    for (int m = 0; m < MODES; m++) { /* also warms caches and threads */
        if (!has_mode(w, m)) { continue; }
        double once = work_time(w, m, 1);
        once = work_time(w, m, once < length ? 2 : 1);
        passes[m] = once < length ? (int)(length / (once + 1e-7)) + 1 : 1;
    }
    check(w->ctx);
    double taken = 0;
    peak_once(w->ctx, 100000, &taken);
    long loops = (long)(100000 * length / (taken + 1e-5)) + 1;
    for (size_t r = 0; r < n; r++) {
        for (int k = 0; k < 3; k++) {
            if (k == 0 || has_mode(w, F16 + k - 1)) { peaks[k][r] = -peak_half(w->ctx, halves[k], loops, &taken); }
        }
        for (int m = 0; m < MODES; m++) {
            if (has_mode(w, m)) { times[m][r] = work_time(w, m, passes[m]); }
        }
        for (int side = 0; side < (one ? 2 : 0); side++) {
            highest[side] = fmax(highest[side], peak_wall(side ? w : one, loops));
            for (int m = 0; m < ALIVE; m++) {
                if (!has_mode(w, m)) { continue; }
                double seconds = side ? times[m][r] : work_time(one, m, passes[m]);
                fastest[side][m] = fmax(fastest[side][m], 1 / (seconds + 1e-9));
            }
        }
    }
    check(w->ctx);
    double share = s->best ? 0.0 : 0.5;
    double forward = quantile(n, times[FORWARD], share);
    for (int m = 0; m < MODES; m++) {
        double largest = 0;
        double squares = 0;
        if (!has_mode(w, m)) { continue; }
        double executed = executed_share(w, m < ALIVE ? FORWARD : m < F16 ? ALIVE : m);
        double peak = -quantile(n, peaks[m < F16 ? 0 : m - F16 + 1], share);
        double seconds = quantile(n, times[m], share);
        double rate = (double)w->batch / seconds;
        double gflops = 2e-9 * w->operations * rate;
        for (size_t i = 0; i < w->batch && m >= F16; i++) {
            double e = fabs((double)w->other_sdf[i] - (double)w->sdf[i]);
            largest = e > largest ? e : largest;
            squares += e * e;
        }
        double speedup = one && m < ALIVE ? fastest[1][m] / fastest[0][m] : 0;
        double of_alive = 0;
        double reverse = 0;
        if (m < WEIGHTS && has_mode(w, ALIVE + m)) {
            double alive = quantile(n, times[ALIVE + m], share);
            of_alive = seconds / alive;
            reverse = m == FORWARD ? 0 : (seconds - forward) / (alive - quantile(n, times[ALIVE], share));
        }
        printf("%s,%s,%d,%.0f,%.6f,%.0f,%.1f,%.1f,%.3f,%s,%.2f,%.3f,%.3g,%.3g,%.3f,%.3f,%.3f,%.3f\n", name,
               dist_isa_name(dist_context_isa(w->ctx)), dist_context_workers(w->ctx), (double)w->batch, seconds, rate,
               gflops, peak, gflops / peak, names[dead][m], seconds / forward, executed, largest,
               sqrt(squares / (double)w->batch), speedup, speedup > 0 ? highest[1] / highest[0] : 0,
               of_alive, reverse);
    }
    fflush(stdout);
}

static dist_net *make_net(dist_context *ctx, const net_case *c, int activation)
{
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = c->layers;
    desc.width = c->width;
    desc.skip = c->skip;
    desc.code_size = c->code_size;
    desc.seed = 1;
    desc.activation = activation;
    dist_net *net = dist_net_create(ctx, &desc);
    check(ctx);
    make_alive(ctx, net);
    return net;
}

static void random_points(size_t n, float *points)
{
    rng r = rng_begin(1);
    for (size_t i = 0; i < 3 * n; i++) {
        points[i] = 1.1f * rng_uniform(&r) - 0.55f;
    }
}

/* Where the rays of a 512 x 512 picture meet the shape, in tiles of 8 x 8 pixels as the tracer goes through them; of
   these, runs of a block's length, spread evenly. Returns the number of points. */
static size_t surface_points(dist_context *ctx, const dist_field *field, size_t room, float *points)
{
    enum { SIZE = 512, TILE = 8, RUN = DISTI_BLOCK };
    view v = view_default(SIZE, SIZE);
    dist_camera camera = view_camera(&v, 0.0f);
    size_t n = 0;
    float *all = take_floats((size_t)3 * SIZE * SIZE);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.distance = take_floats((size_t)SIZE * SIZE);
    out.mask = (unsigned char *)take((size_t)SIZE * SIZE, 1);
    dist_render(ctx, field, &camera, NULL, &out, NULL);
    check(ctx);
    for (int k = 0; k < SIZE * SIZE; k++) {
        int tile = k / (TILE * TILE);
        int x = tile % (SIZE / TILE) * TILE + k % TILE;
        int y = tile / (SIZE / TILE) * TILE + k / TILE % TILE;
        float origin[3];
        float direction[3];
        if (!out.mask[y * SIZE + x]) { continue; }
        dist_camera_ray(&camera, (float)x, (float)y, origin, direction);
        for (int a = 0; a < 3; a++) {
            all[3 * n + (size_t)a] = origin[a] + out.distance[y * SIZE + x] * direction[a];
        }
        n++;
    }
    size_t runs = room / RUN < n / RUN ? room / RUN : n / RUN;
    if (runs == 0) { fail("the model shows only %.0f pixels; nothing to measure", (double)n); }
    for (size_t i = 0; i < runs; i++) {
        size_t first = i * (n - RUN) / runs;
        memcpy(points + 3 * RUN * i, all + 3 * first, 3 * RUN * sizeof(float));
    }
    free(all);
    free(out.distance);
    free(out.mask);
    return runs * RUN;
}

/* One net on one instruction set and number of threads. c: the random net to make; NULL: s->model. */
static void measure_net(const settings *s, const net_case *c, int isa, int threads)
{
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.isa = isa;
    desc.workers = threads;
    work w;
    memset(&w, 0, sizeof w);
    w.ctx = dist_context_create(&desc);
    check(w.ctx);
    dist_net *net = c ? make_net(w.ctx, c, s->activation) : load_model(w.ctx, s->model);
    const float *code = c ? NULL : dist_net_code(net, s->code);
    if (!c && dist_net_code_size(net) && !code) { fail("%s has no code %d", s->model, s->code); }
    dist_shape *shape = dist_shape_create(w.ctx, net, code);
    w.field = dist_shape_field(shape);
    w.operations = (double)dist_net_operations(net, 1);
    check(w.ctx);
    int blocks = isa == DIST_ISA_SCALAR ? 4 : s->quick ? 16 : c && c->width < 128 ? 256 : 64;
    w.batch = (size_t)blocks * DISTI_BLOCK;
    float *points = take_floats(3 * w.batch);
    if (c) { random_points(w.batch, points); }
    if (!c) { w.batch = surface_points(w.ctx, &w.field, w.batch, points); }
    if (s->points > 0 && (size_t)s->points < w.batch) { w.batch = (size_t)s->points; }
    w.points = points;
    w.sdf = take_floats(w.batch);
    w.other_sdf = take_floats(w.batch);
    w.d_sdf = take_floats(w.batch);
    w.gradient = take_floats(3 * w.batch);
    if (dist_net_code_size(net)) { w.d_code = take_floats((size_t)dist_net_code_size(net)); }
    w.d_weights = take_floats(dist_net_weight_count(net));
    dist_net *halves[2] = {NULL, NULL};
    dist_shape *shapes[2] = {NULL, NULL};
    for (int k = 0; k < 2 && isa == DIST_ISA_AVX512; k++) {
        int kind = k == 0 ? DIST_HALF_F16 : DIST_HALF_BF16;
        if (!disti_cpu_half(kind) || net->normed) { continue; }
        halves[k] = c ? make_net(w.ctx, c, s->activation) : load_model(w.ctx, s->model);
        dist_net_set_half(w.ctx, halves[k], kind);
        shapes[k] = dist_shape_create(w.ctx, halves[k], code);
        check(w.ctx);
        w.half[k] = dist_shape_field(shapes[k]);
        w.half[k].eval_fn = w.half[k].coarse_fn;
    }
    dist_net *alive = NULL;
    dist_shape *alive_shape = NULL;
    if (!c && net->activation == DIST_ACTIVATION_RELU) {
        alive = load_model(w.ctx, s->model);
        make_alive(w.ctx, alive);
        alive_shape = dist_shape_create(w.ctx, alive, code);
        check(w.ctx);
        w.alive = dist_shape_field(alive_shape);
    }
    work one = w;
    desc.workers = 1;
    one.wall = 1;
    one.ctx = threads > 1 ? dist_context_create(&desc) : NULL;
    dist_shape *alone = threads > 1 ? dist_shape_create(one.ctx, net, code) : NULL;
    if (alone) { one.field = dist_shape_field(alone); }
    if (one.ctx) { check(one.ctx); }
    measure(s, c ? c->name : s->model, &w, alone ? &one : NULL, !c);
    dist_shape_destroy(alone);
    dist_context_destroy(one.ctx);
    dist_shape_destroy(alive_shape);
    dist_net_destroy(alive);
    for (int k = 0; k < 2; k++) {
        dist_shape_destroy(shapes[k]);
        dist_net_destroy(halves[k]);
    }
    free(points);
    free(w.sdf);
    free(w.other_sdf);
    free(w.d_sdf);
    free(w.gradient);
    free(w.d_code);
    free(w.d_weights);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(w.ctx);
}

static settings read_options(int argc, char **argv)
{
    settings s = {NULL, NULL, NULL, 0, 2, 0, 9, 0, 0, 0};
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--case")) {
            s.only_case = option_text(&o);
        } else if (option_is(&o, "--isa")) {
            s.only_isa = option_text(&o);
        } else if (option_is(&o, "--threads")) {
            s.threads = option_int(&o, 1, 64);
        } else if (option_is(&o, "--model")) {
            s.model = option_text(&o);
        } else if (option_is(&o, "--code")) {
            s.code = option_int(&o, 0, 1 << 30);
        } else if (option_is(&o, "--activation")) {
            s.activation = option_choice(&o, activations);
        } else if (option_is(&o, "--points")) {
            s.points = option_int(&o, 1, 64 * DISTI_BLOCK);
        } else if (option_is(&o, "--repetitions")) {
            s.repetitions = option_int(&o, 1, REPETITIONS_MAX);
        } else if (option_is(&o, "--best")) {
            s.best = option_flag(&o);
        } else if (option_is(&o, "--quick")) {
            s.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    return s;
}

int main(int argc, char **argv)
{
    settings s = read_options(argc, argv);
    int most = 1;
    if (s.model && s.activation) { fail("--activation is of the random nets, not of --model %s", s.model); }
#if defined(_OPENMP) && !defined(DIST_NO_OPENMP)
    most = s.quick ? 1 : s.threads;
#endif
    puts("case,isa,threads,batch,seconds,queries_per_s,gflops,peak_gflops,share,mode,of_forward,executed,max_error,"
         "rms_error,speedup,peak_speedup,of_alive,reverse_of_alive");
    int found = 0, measured = 0;
    for (int i = 0; i < (s.model ? 1 : (int)CASES); i++) {
        const net_case *c = s.model ? NULL : &cases[i];
        if (c && s.only_case && strcmp(s.only_case, c->name) != 0) { continue; }
        if (c && s.quick && !s.only_case && i != 0 && i + 1 != CASES) { continue; }
        found = 1;
        for (int isa = DIST_ISA_SCALAR; isa <= DIST_ISA_NEON; isa++) {
            if (!disti_cpu_has(isa)) { continue; }
            if (s.quick && !s.only_isa && isa == DIST_ISA_SCALAR && i == 0) { continue; } /* seconds a pass */
            if (s.only_isa && strcmp(s.only_isa, dist_isa_name(isa)) != 0) { continue; }
            for (int threads = 1; threads <= most; threads += most > 1 ? most - 1 : 1) {
                measure_net(&s, c, isa, threads);
                measured = 1;
            }
        }
    }
    check_found("--case", s.only_case, found);
    check_found("--isa", s.only_isa, measured);
    return 0;
}
