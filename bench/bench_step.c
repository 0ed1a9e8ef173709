/* SPDX-License-Identifier: MIT-0
   bench_step.c - what a whole step of an optimization costs: render (depth, silhouette, mask), losses, gradient for the
   code, Adam; and what a frame costs that is only looked at. CSV on stdout.

   ratio is the step's time divided by the time that 887,000 queries of the same net, not folded, would take at the
   multiply-add peak measured in the same run with the same threads: the paper's step, had its arithmetic been done at
   full speed. mode cold: every picture traced anew; warm: each
   starts from the last one; frame: depth, normals and mask, no gradient.
   bytes: most memory held beside the caller's planes and the weights. moved: mean change of depth of a step, in radii;
   in the warm rows Adam's rate is lowered until that is at most --moved. render, backward: seconds of these parts;
   their rates: dense multiply-adds (backward: a forward and a reverse pass a point) at the peak, over the time.
   network_rate: as the render's rate, over the time spent in the network alone, in blocks of points as the tracer asks
   them; 0: not measured (frames, more than 256 threads).
   The camera is 2.2 radii away with a focal length of 385 pixels at 512, as in bench_trace. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "peak.h"

static const char usage[] =
    "bench_step [options]\n"
    "  --case NAME        only this one\n"
    "  --size N           pixels along a side of the steps (default 512)\n"
    "  --steps N          measured steps of a fit (default 12)\n"
    "  --rate R           Adam's, at first (default 0.001)\n"
    "  --moved R          of the warm rows: radii a step at most (default 0.0005)\n"
    "  --depth            depth alone, no silhouette\n"
    "  --threads N        threads (default all)\n"
    "  --quick            128 pixels, few cases\n";

typedef struct step_case {
    const char *name, *net; /* net NULL: made here, layers x width, a sphere's distance */
    int code, layers, width, quick;
} step_case;

static const step_case cases[] = {
    {"deepsdf_512", "deepsdf_512", 0, 8, 512, 1},
    {"embedded", "embedded", 5, 0, 0, 1},
    {"bob_spot", "bob_spot", 1, 0, 0, 1},
    {"spot_geometry", "spot_geometry", 0, 0, 0, 0},
    {"round_cross", "round_cross", 10, 0, 0, 0},
    {"primitives", "primitives", 13, 0, 0, 0},
    {"mug_camera_bottle", "mug_camera_bottle", 0, 0, 0, 0},
    {"chairs", "chairs", 3, 0, 0, 0},
    {"deepsdf_512_he", "deepsdf_512_he", 0, 0, 0, 0},
};

typedef struct frame_case {
    const char *name;
    int layers, width, pixels_x, pixels_y;
} frame_case;

static const frame_case frames[] = {{"game_4x64", 4, 64, 512, 512}, {"game_2x32", 2, 32, 640, 360}};

enum { CASES = sizeof cases / sizeof cases[0], FRAME_CASES = sizeof frames / sizeof frames[0], STEPS_MOST = 1000 };
static const double PAPER_QUERIES = 887000;

typedef struct settings {
    const char *only;
    int size, steps, threads, quick;
    float rate, moved;
    int depth; /* 1: no silhouette */
} settings;

/* ---- memory ------------------------------------------------------------------------------------------------------ */

typedef struct meter {
    size_t held, most;
} meter;

static void *meter_alloc(void *user, size_t bytes, size_t alignment)
{
    meter *m = (meter *)user;
    unsigned char *raw = (unsigned char *)malloc(bytes + alignment);
    if (!raw) { return NULL; }
    size_t shift = alignment - (size_t)raw % alignment; /* 1 to alignment: kept in the byte before */
    raw[shift - 1] = (unsigned char)shift;
    m->held += bytes;
    m->most = m->held > m->most ? m->held : m->most;
    return raw + shift;
}

static void meter_free(void *user, void *p, size_t bytes)
{
    unsigned char *q = (unsigned char *)p;
    ((meter *)user)->held -= bytes;
    free(q - q[-1]);
}

/* ---- time in the network ----------------------------------------------------------------------------------------- */

enum { WORKERS_MOST = 256, APART = 16 }; /* APART: doubles from one worker's place to the next, not in one cache line */
static void (*network_eval)(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient);
static double network_seconds[WORKERS_MOST * APART];

/* The field's own eval_fn, timed. */
static void timed_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    double start = seconds_now();
    network_eval(user, worker, n, points, sdf, gradient);
    network_seconds[worker * APART] += seconds_now() - start;
}

/* Of all workers, since the last call. */
static double network_spent(void)
{
    double sum = 0;
    for (int i = 0; i < WORKERS_MOST; i++) {
        sum += network_seconds[i * APART];
        network_seconds[i * APART] = 0;
    }
    return sum;
}

/* ---- the step ---------------------------------------------------------------------------------------------------- */

static dist_net *made_net(dist_context *ctx, int layers, int width, int code_size, int skip)
{
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = layers;
    desc.width = width;
    desc.code_size = code_size;
    desc.code_count = code_size ? 1 : 0;
    desc.skip = skip;
    desc.geometric = 1;
    desc.seed = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    check(ctx);
    return net;
}

/* The case's net: the file, or where it is absent one of the same size that is a sphere. NULL: left out. */
static dist_net *net_of(dist_context *ctx, const step_case *c)
{
    dist_net *net = c->net ? load_net_or_skip(ctx, c->net) : NULL;
    return net || !c->width ? net : made_net(ctx, c->layers, c->width, c->net ? 256 : 0, c->net ? 4 : 0);
}

typedef struct stepper {
    dist_context *ctx;
    dist_shape *shape;
    dist_field field;
    dist_camera camera;
    dist_render_desc how;
    dist_tape *tape;
    dist_images out, d_out;
    dist_stats stats;
    dist_adam adam;
    size_t n, code_size;
    float *code, *d_code, *target, *before;
    unsigned char *target_mask;
} stepper;

static stepper stepper_create(dist_context *ctx, const dist_net *net, int code, const settings *set, float rate,
                              int warm)
{
    int size = set->size;
    stepper s;
    memset(&s, 0, sizeof s);
    s.ctx = ctx;
    s.n = (size_t)size * (size_t)size;
    s.code_size = (size_t)dist_net_code_size(net);
    s.code = take_floats(s.code_size);
    s.d_code = take_floats(s.code_size);
    if (dist_net_code(net, code)) { memcpy(s.code, dist_net_code(net, code), s.code_size * sizeof(float)); }
    s.shape = dist_shape_create(ctx, net, s.code);
    s.field = dist_shape_field(s.shape);
    if (dist_context_workers(ctx) <= WORKERS_MOST) {
        network_eval = s.field.eval_fn;
        s.field.eval_fn = timed_eval;
    }
    s.camera = bench_camera(&s.field, size, size);
    s.how.warm_start = warm;
    s.tape = dist_tape_create(ctx, &s.camera, &s.how);
    check(ctx);
    s.target = take_floats(s.n);
    s.before = take_floats(s.n);
    s.target_mask = (unsigned char *)take(s.n, 1);
    s.out.depth = s.target;
    s.out.mask = s.target_mask;
    dist_render(ctx, &s.field, &s.camera, NULL, &s.out, NULL); /* what is to be reached */
    check(ctx);
    s.out.depth = take_floats(s.n);
    s.out.silhouette = set->depth ? NULL : take_floats(s.n);
    s.out.mask = (unsigned char *)take(s.n, 1);
    s.d_out.depth = take_floats(s.n);
    s.d_out.silhouette = set->depth ? NULL : take_floats(s.n);
    s.adam.rate = rate;
    s.adam.moments = take_floats(2 * s.code_size);
    rng r = rng_begin(1);
    float size_of_code = 0; /* the fit starts a twentieth of the code's own size away */
    for (size_t i = 0; i < s.code_size; i++) {
        size_of_code += s.code[i] * s.code[i];
    }
    size_of_code = size_of_code > 0 ? sqrtf(size_of_code / (float)s.code_size) : 1.0f;
    for (size_t i = 0; i < s.code_size; i++) {
        s.code[i] += 0.05f * size_of_code * (2.0f * rng_uniform(&r) - 1.0f);
    }
    return s;
}

static void stepper_destroy(stepper *s)
{
    dist_tape_destroy(s->tape);
    dist_shape_destroy(s->shape);
    free(s->code);
    free(s->d_code);
    free(s->target);
    free(s->before);
    free(s->target_mask);
    free(s->out.depth);
    free(s->out.silhouette);
    free(s->out.mask);
    free(s->d_out.depth);
    free(s->d_out.silhouette);
    free(s->adam.moments);
}

/* One step; its seconds, those of the render and the backward pass, and the workers' in the render's network. */
static double step_once(stepper *s, double *render, double *backward, double *network)
{
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = s->d_code;
    s->out.stats = s->d_out.stats = &s->stats;
    double start = seconds_now();
    memset(s->d_out.depth, 0, s->n * sizeof(float));
    if (s->d_out.silhouette) { memset(s->d_out.silhouette, 0, s->n * sizeof(float)); }
    memset(s->d_code, 0, s->code_size * sizeof(float));
    dist_shape_set_code(s->shape, s->code);
    network_spent();
    double render_start = seconds_now();
    dist_render(s->ctx, &s->field, &s->camera, &s->how, &s->out, s->tape);
    *render = seconds_now() - render_start;
    *network = network_spent();
    dist_loss_depth(s->n, s->out.depth, s->target, s->out.mask, 10.0f, s->d_out.depth);
    if (s->out.silhouette) {
        dist_loss_silhouette(s->n, s->out.silhouette, s->target_mask, 1.0f, s->d_out.silhouette);
    }
    dist_loss_code(s->code_size, s->code, 1.0f / (float)s->code_size, s->d_code);
    double backward_start = seconds_now();
    dist_render_backward(s->ctx, s->tape, &s->d_out, &grads);
    *backward = seconds_now() - backward_start;
    dist_adam_step(&s->adam, s->code_size, s->code, s->d_code);
    check(s->ctx);
    return seconds_now() - start;
}

/* Mean change of depth since the last picture, over the pixels that hit in both. */
static double step_moved(stepper *s)
{
    double sum = 0;
    double count = 0;
    for (size_t i = 0; i < s->n; i++) {
        if (s->before[i] > 0.0f && s->out.mask[i]) {
            sum += fabs((double)s->before[i] - (double)s->out.depth[i]);
            count += 1;
        }
        s->before[i] = s->out.mask[i] ? s->out.depth[i] : 0.0f;
    }
    return count > 0 ? sum / count / (double)s->field.radius : 0;
}

typedef struct row {
    double seconds, queries, backward_points, peak, moved, hits, render, backward, network, dense, rate;
} row;

/* The median of `steps` steps, after one that is not counted. */
static row run_steps(stepper *s, int steps)
{
    static double seconds[STEPS_MOST], queries[STEPS_MOST], points[STEPS_MOST], moved[STEPS_MOST], peaks[STEPS_MOST];
    static double renders[STEPS_MOST], backwards[STEPS_MOST], networks[STEPS_MOST];
    double taken, render, backward, network;
    row r;
    memset(&r, 0, sizeof r);
    for (int i = -1; i < steps; i++) {
        double once = step_once(s, &render, &backward, &network);
        double change = step_moved(s);
        if (i < 0) { continue; }
        seconds[i] = once;
        renders[i] = render;
        backwards[i] = backward;
        networks[i] = network / dist_context_workers(s->ctx);
        queries[i] = (double)s->stats.queries;
        points[i] = (double)s->stats.backward_points;
        moved[i] = change;
        peaks[i] = peak_once(s->ctx, 8000000, &taken);
    }
    r.seconds = median((size_t)steps, seconds);
    r.queries = median((size_t)steps, queries);
    r.backward_points = median((size_t)steps, points);
    r.moved = median((size_t)steps, moved);
    r.peak = median((size_t)steps, peaks);
    r.render = median((size_t)steps, renders);
    r.backward = median((size_t)steps, backwards);
    r.network = median((size_t)steps, networks);
    r.dense = r.queries > 0 ? s->stats.operations / (double)s->stats.queries : 0;
    r.hits = (double)s->stats.hits;
    r.rate = (double)s->adam.rate;
    return r;
}

static void print_row(const char *name, const char *mode, int width, int height, dist_context *ctx, double operations,
                      const row *r, size_t bytes)
{
    double whole = PAPER_QUERIES * 2.0 * operations / (r->peak * 1e9);
    char resolution[32];
    snprintf(resolution, sizeof resolution, width == height ? "%d" : "%dx%d", width, height);
    double render_rate = r->render > 0 ? r->queries * 2.0 * r->dense / (r->render * r->peak * 1e9) : 0;
    double backward_rate =
        r->backward > 0 ? r->backward_points * 4.0 * r->dense / (r->backward * r->peak * 1e9) : 0;
    double network_rate = r->network > 0 ? r->queries * 2.0 * r->dense / (r->network * r->peak * 1e9) : 0;
    printf("%s,%s,%s,%d,%.5f,%.0f,%.0f,%.1f,%.4f,%.0f,%.0f,%.2f,%.1e,", name, mode, resolution,
           dist_context_workers(ctx), r->seconds, r->queries, r->backward_points, r->peak, r->seconds / whole,
           (double)bytes, r->hits, r->hits > 0 ? r->queries / r->hits : 0, r->moved);
    printf("%.5f,%.5f,%.2f,%.2f,%.1e,%.2f\n", r->render, r->backward, render_rate, backward_rate, r->rate, network_rate);
    fflush(stdout);
}

static void run_case(dist_context *ctx, const step_case *c, const settings *set, meter *memory)
{
    size_t before = memory->held;
    dist_net *net = net_of(ctx, c);
    if (!net) { return; }
    size_t weights = memory->held - before;
    for (int warm = 0; warm < 2; warm++) {
        float rate = set->rate;
        memory->most = memory->held;
        stepper s = stepper_create(ctx, net, c->code, set, rate, warm);
        row r = run_steps(&s, set->steps);
        for (int i = 0; warm && i < 12 && r.moved > (double)set->moved; i++) { /* about proportional to the rate */
            rate *= (float)fmin(0.5, 0.9 * (double)set->moved / r.moved);
            stepper_destroy(&s);
            s = stepper_create(ctx, net, c->code, set, rate, warm);
            r = run_steps(&s, set->steps);
        }
        print_row(c->name, warm ? "warm" : "cold", set->size, set->size, ctx, (double)dist_net_operations(net, 0), &r,
                  memory->most - weights);
        stepper_destroy(&s);
    }
    dist_net_destroy(net);
}

/* Frames of a game: a small net, depth, normals and mask, the camera on its way around. */
static void run_frames(dist_context *ctx, const char *name, int layers, int width, int pixels_x, int pixels_y,
                       meter *memory)
{
    enum { FRAMES = 24 };
    double seconds[FRAMES];
    double taken;
    size_t n = (size_t)pixels_x * (size_t)pixels_y;
    dist_net *net = made_net(ctx, layers, width, 0, 0);
    memory->most = memory->held;
    size_t before = memory->held;
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    field.cost = 1; /* time counts, not queries */
    dist_images out;
    dist_stats stats;
    row r;
    memset(&out, 0, sizeof out);
    memset(&r, 0, sizeof r);
    out.depth = take_floats(n);
    out.normal = take_floats(3 * n);
    out.mask = (unsigned char *)take(n, 1);
    out.stats = &stats;
    for (int i = 0; i < FRAMES; i++) {
        dist_camera camera = bench_camera(&field, pixels_x, pixels_y);
        float turn[3] = {0, 0.05f * (float)i, 0};
        dist_camera_move(&camera, turn, NULL);
        camera.translation[0] = camera.translation[1] = 0; /* the center stays in the middle */
        camera.translation[2] = 2.2f * field.radius;
        double start = seconds_now();
        dist_render(ctx, &field, &camera, NULL, &out, NULL);
        check(ctx);
        seconds[i] = seconds_now() - start;
        r.hits = (double)stats.hits;
        r.queries = (double)stats.queries;
    }
    r.seconds = median(FRAMES, seconds);
    r.peak = peak_once(ctx, 8000000, &taken);
    print_row(name, "frame", pixels_x, pixels_y, ctx, (double)dist_net_operations(net, 0), &r, memory->most - before);
    fprintf(stderr, "%s: %.1f frames a second\n", name, 1.0 / r.seconds);
    free(out.depth);
    free(out.normal);
    free(out.mask);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
}

int main(int argc, char **argv)
{
    settings set = {NULL, 512, 12, 0, 0, 1e-3f, 5e-4f, 0};
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--case")) {
            set.only = option_text(&o);
        } else if (option_is(&o, "--size")) {
            set.size = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--steps")) {
            set.steps = option_int(&o, 1, STEPS_MOST);
        } else if (option_is(&o, "--rate")) {
            set.rate = (float)option_number(&o, 1e-9, 1e3);
        } else if (option_is(&o, "--depth")) {
            set.depth = 1;
        } else if (option_is(&o, "--moved")) {
            set.moved = (float)option_number(&o, 1e-9, 1);
        } else if (option_is(&o, "--threads")) {
            set.threads = option_int(&o, 1, 1024);
        } else if (option_is(&o, "--quick")) {
            set.quick = option_flag(&o);
            set.size = 128;
            set.steps = 4;
        } else {
            option_unknown(&o);
        }
    }
    meter memory = {0, 0};
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.workers = set.threads;
    desc.allocator.user = &memory;
    desc.allocator.alloc_fn = meter_alloc;
    desc.allocator.free_fn = meter_free;
    dist_context *ctx = dist_context_create(&desc);
    check(ctx);
    puts("case,mode,resolution,threads,seconds,queries,backward_points,peak_gflops,ratio,bytes,hits,"
         "queries_per_hit,moved,render,backward,render_rate,backward_rate,rate,network_rate");
    int found = 0;
    for (int i = 0; i < CASES; i++) {
        int wanted = set.only ? strcmp(set.only, cases[i].name) == 0 : !set.quick || cases[i].quick;
        if (!wanted) { continue; }
        run_case(ctx, &cases[i], &set, &memory);
        found = 1;
    }
    for (int i = 0; i < FRAME_CASES; i++) {
        const frame_case *f = &frames[i];
        if (set.only && strcmp(set.only, f->name) != 0) { continue; }
        run_frames(ctx, f->name, f->layers, f->width, f->pixels_x, f->pixels_y, &memory);
        found = 1;
    }
    check_found("--case", set.only, found);
    dist_context_destroy(ctx);
    return 0;
}
