/* SPDX-License-Identifier: MIT-0
   bench_grow.c - how time and queries grow with the resolution, the network's width and depth, threads and views: the
   paper's tracer (coarse to fine, 50 steps) and ours, in turn within one loop. CSV on stdout, sums on stderr.

   A row is the median of `runs`, which are a third as many at 2048. speed_ratio and query_ratio: how many times less
   time and queries than the paper's row beside it. differs: pixels per thousand of the larger picture that only one of
   the two says are hit; apart: mean difference of their depths, in radii. The pictures are depth and mask alone, but
   for the views: a step of an optimization from that many views, of depth, silhouette and mask, with the gradient for
   the code, which moves a little from step to step; there `guarded, warm` starts from the last step's picture. Widths
   and depths are those of ReLU nets made here that all are a sphere's distance, half of whose units are dead at a
   point. The camera is that of bench_trace. Dead units are left out for both tracers, which helps the paper's more, as
   most of its queries lie far from the surface. For compact shapes paper_dense is it with all units, as its authors run
   it, and speed_ratio_dense how many times less time than that ours takes. guarded_coarse is ours at the first
   epsilon of 1.28e-2 and its halves whose picture is no farther off than the paper's: mean_error and p99_error of the
   depth, in radii, where both it and ours at 1e-6 are hits, and wrong, pixels where only one of them is. epsilon is in
   the units of the field. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "plot.h"

static const char usage[] =
    "bench_grow [options]\n"
    "  --sweep NAME       resolution, width, depth, threads, views or compact: only this one\n"
    "  --threads N        threads (default 1) of all sweeps but that of threads\n"
    "  --runs N           of each row, at least (default 7; quick 3)\n"
    "  --svg STEM         also plots, STEM_SWEEP.svg\n"
    "  --quick            smaller pictures, fewer cases\n";

enum { PAPER, GUARDED, WARM, METHODS, DENSE = METHODS, COARSE, MOST_RUNS = 64, MOST_VIEWS = 16, MOST_ROWS = 1024 };
static const char *const method_names[] = {"paper", "guarded", "guarded, warm", "paper, dense",
                                           "guarded, coarse"};
static const char *const method_words[] = {"paper", "guarded", "guarded_warm", "paper_dense", "guarded_coarse"};

typedef struct grow_case {
    const char *name, *net;
    int code, in_quick;
} grow_case;

/* Compact shapes: they fill a good part of the picture and are nowhere thin. */
static const grow_case compact[] = {
    {"embedded_5", "embedded", 5, 1}, {"embedded_70", "embedded", 70, 0}, {"embedded_20", "embedded", 20, 0},
    {"fox", "fox", 0, 1},             {"bunny_relu", "bunny_relu", 0, 1}, {"bob", "bob_spot", 0, 0},
    {"spot", "bob_spot", 1, 1},
};
enum { COMPACT = sizeof compact / sizeof compact[0] };

typedef struct settings {
    const char *sweep, *svg;
    int threads, runs, quick;
} settings;

typedef struct row {
    const char *sweep, *name;
    int method, resolution, layers, width, threads, views, runs;
    double x; /* what the sweep varies */
    double queries, operations, done, seconds, fastest, slowest, hits, speed_ratio, query_ratio, differs, apart;
    double dense_ratio, epsilon, mean, p99, wrong; /* the last three: 0 where there is no reference */
} row;

typedef struct table {
    row *rows;
    size_t n;
} table;

/* ---- measuring --------------------------------------------------------------------------------------------------- */

typedef struct planes {
    float *depth, *silhouette;
    unsigned char *mask;
} planes;

static planes planes_create(size_t n)
{
    planes p = {take_floats(n), take_floats(n), (unsigned char *)take(n, 1)};
    return p;
}

static void planes_destroy(planes *p)
{
    free(p->depth);
    free(p->silhouette);
    free(p->mask);
}

/* Where the pictures of our tracer and the paper's differ. */
static void compare(const planes *a, const planes *b, size_t n, double radius, row *r)
{
    double only_one = 0;
    double both = 0;
    for (size_t i = 0; i < n; i++) {
        only_one += a->mask[i] != b->mask[i];
        if (!a->mask[i] || !b->mask[i]) { continue; }
        r->apart += fabs((double)a->depth[i] - (double)b->depth[i]) / radius;
        both += 1;
    }
    r->apart /= both > 0 ? both : 1;
    r->differs = both + only_one > 0 ? 1000 * only_one / (both + only_one) : 0;
}

/* Mean and 99th percentile of what depth is off where both are hits; pixels where one is. */
static void errors_of(const planes *a, const planes *exact, size_t n, double radius, row *r)
{
    double *off = (double *)take(n, sizeof *off);
    size_t both = 0;
    r->mean = r->wrong = 0;
    for (size_t i = 0; i < n; i++) {
        r->wrong += a->mask[i] != exact->mask[i];
        if (!a->mask[i] || !exact->mask[i]) { continue; }
        off[both] = fabs((double)a->depth[i] - (double)exact->depth[i]) / radius;
        r->mean += off[both++];
    }
    r->mean /= both ? (double)both : 1;
    r->p99 = quantile(both, off, 0.99);
    free(off);
}

static dist_render_desc how_of(int method)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.trace = method == PAPER || method == DENSE ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
    how.paper_row = DIST_PAPER_COARSE_TO_FINE;
    how.warm_start = method == WARM;
    return how;
}

static void row_finish(row *r, size_t runs, double *seconds, const dist_stats *stats)
{
    r->runs = (int)runs;
    r->seconds = median(runs, seconds);
    r->fastest = seconds[0];
    r->slowest = seconds[runs - 1];
    r->queries = (double)stats->queries;
    r->operations = stats->operations;
    r->done = stats->operations_done;
    r->hits = (double)stats->hits;
}

static void add_rows(table *t, row *rows, int count, const row *dense)
{
    for (int m = 0; m < count; m++) {
        row *r = &rows[m];
        r->dense_ratio = dense ? dense->seconds / r->seconds : 0;
        r->speed_ratio = rows[PAPER].seconds / r->seconds;
        r->query_ratio = rows[PAPER].queries / (r->queries > 0 ? r->queries : 1);
        printf("%s,%s,%s,%d,%d,%d,%d,%d,%.0f,%.4f,%.4g,%.4g,%.5f,%.5f,%.5f,%d,%.0f,%.3f,%.3f,%.3f,%.2e,%.3f,%.1e,"
               "%.2e,%.2e,%.0f\n",
               r->sweep, r->name, method_words[r->method], r->resolution, r->layers, r->width, r->threads, r->views,
               r->queries, r->queries / ((double)r->resolution * r->resolution * r->views), r->operations, r->done,
               r->seconds, r->fastest, r->slowest, r->runs, r->hits, r->speed_ratio, r->query_ratio, r->differs,
               r->apart, r->dense_ratio, r->epsilon, r->mean, r->p99, r->wrong);
        if (t->n == MOST_ROWS) { fail("more than %d rows", MOST_ROWS); }
        t->rows[t->n++] = *r;
    }
    fflush(stdout);
}

/* Seconds of one picture of depth and mask. */
static double picture_once(dist_context *ctx, dist_shape *shape, const dist_camera *camera, int method, double epsilon,
                           const planes *p, dist_stats *stats)
{
    dist_field field = dist_shape_field(shape);
    dist_render_desc how = how_of(method);
    uint32_t all_alive = shape->all_alive;
    int groups = shape->groups;
    dist_images out;
    memset(&out, 0, sizeof out);
    memset(stats, 0, sizeof *stats);
    out.depth = p->depth;
    out.mask = p->mask;
    out.stats = stats;
    how.epsilon = (float)epsilon;
    if (method == DENSE) {
        shape->all_alive = ~(uint32_t)0;
        shape->groups = 0;
    }
    double start = seconds_now();
    dist_render(ctx, &field, camera, &how, &out, NULL);
    double seconds = seconds_now() - start;
    shape->all_alive = all_alive;
    shape->groups = groups;
    check(ctx);
    return seconds;
}

/* The epsilon of guarded_coarse; 0: none is as exact. */
static double coarse_epsilon(dist_context *ctx, dist_shape *shape, const dist_camera *camera, const planes *exact,
                             double radius, const row *paper)
{
    size_t n = (size_t)camera->width * (size_t)camera->height;
    planes p = planes_create(n);
    dist_stats stats;
    row r;
    double epsilon = 1.28e-2;
    for (; epsilon > 1e-5; epsilon /= 2) {
        picture_once(ctx, shape, camera, COARSE, epsilon, &p, &stats);
        errors_of(&p, exact, n, radius, &r);
        if (r.mean <= paper->mean && r.p99 <= paper->p99 && r.wrong <= paper->wrong) { break; }
    }
    planes_destroy(&p);
    return epsilon > 1e-5 ? epsilon : 0;
}

/* Depth and mask of one view by the tracers in turn, at least `runs` times and up to a second; `more`: also the paper's
   with all units, and ours as far off as the paper's. */
static void measure_picture(dist_context *ctx, dist_shape *shape, int runs, int more, const row *what, table *t)
{
    enum { MOST = 4 };
    static const int method[MOST] = {PAPER, GUARDED, DENSE, COARSE};
    static double seconds[MOST][MOST_RUNS];
    dist_field field = dist_shape_field(shape);
    dist_camera camera = bench_camera(&field, what->resolution, what->resolution);
    size_t n = (size_t)what->resolution * (size_t)what->resolution;
    double radius = (double)field.radius;
    planes p[MOST], exact = planes_create(n);
    row rows[MOST];
    dist_stats stats[MOST];
    size_t count = 0;
    int methods = more ? MOST : 2;
    for (int m = 0; m < methods; m++) {
        p[m] = planes_create(n);
        rows[m] = *what;
        rows[m].method = method[m];
    }
    if (more) {
        picture_once(ctx, shape, &camera, GUARDED, 1e-6, &exact, &stats[0]);
        picture_once(ctx, shape, &camera, PAPER, 0, &p[0], &stats[0]);
        errors_of(&p[0], &exact, n, radius, &rows[0]);
        double epsilon = coarse_epsilon(ctx, shape, &camera, &exact, radius, &rows[0]);
        rows[methods - 1].epsilon = epsilon;
        if (!(epsilon > 0)) {
            fprintf(stderr, "%s: at no epsilon as exact as the paper's\n", what->name);
            methods--;
        }
    }
    double begin = seconds_now();
    do {
        for (int m = 0; m < methods; m++) {
            seconds[m][count] = picture_once(ctx, shape, &camera, method[m], rows[m].epsilon, &p[m], &stats[m]);
        }
        count++;
    } while (count < (size_t)runs || (count < 7 && seconds_now() - begin < 1));
    for (int m = 0; m < methods; m++) {
        row_finish(&rows[m], count, seconds[m], &stats[m]);
        rows[m].epsilon = stats[m].epsilon > 0 ? (double)stats[m].epsilon : rows[m].epsilon;
        if (m) { compare(&p[0], &p[m], n, radius, &rows[m]); }
        if (more) { errors_of(&p[m], &exact, n, radius, &rows[m]); }
    }
    add_rows(t, rows, methods, more ? &rows[2] : NULL);
    for (int m = 0; m < methods; m++) { planes_destroy(&p[m]); }
    planes_destroy(&exact);
}

typedef struct views {
    dist_camera camera[MOST_VIEWS];
    dist_tape *tape[MOST_VIEWS];
    planes p;
} views;

/* One step from all views; its seconds. Every pixel pulls at the code. */
static double step_once(dist_context *ctx, dist_shape *shape, const float *code, int count, views *v, int method,
                        const planes *ones, float *d_code, dist_stats *sum)
{
    dist_render_desc how = how_of(method);
    dist_field field = dist_shape_field(shape);
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = d_code;
    memset(sum, 0, sizeof *sum);
    double start = seconds_now();
    dist_shape_set_code(shape, code);
    for (int i = 0; i < count; i++) {
        dist_images out, d_out;
        dist_stats stats;
        memset(&out, 0, sizeof out);
        memset(&d_out, 0, sizeof d_out);
        memset(&stats, 0, sizeof stats);
        out.depth = v->p.depth;
        out.silhouette = v->p.silhouette;
        out.mask = v->p.mask;
        d_out.depth = ones->depth;
        d_out.silhouette = ones->silhouette;
        out.stats = d_out.stats = &stats;
        dist_render(ctx, &field, &v->camera[i], &how, &out, v->tape[i]);
        dist_render_backward(ctx, v->tape[i], &d_out, &grads);
        sum->queries += stats.queries;
        sum->hits += stats.hits;
        sum->operations += stats.operations;
        sum->operations_done += stats.operations_done;
    }
    check(ctx);
    return seconds_now() - start;
}

/* Steps of all three methods in turn, from `what->views` places around the shape. */
static void measure_views(dist_context *ctx, const dist_net *net, const float *code, int runs, const row *what,
                          table *t)
{
    static double seconds[METHODS][MOST_RUNS];
    size_t n = (size_t)what->resolution * (size_t)what->resolution;
    size_t code_size = (size_t)dist_net_code_size(net);
    dist_shape *shape = dist_shape_create(ctx, net, code);
    dist_field field = dist_shape_field(shape);
    check(ctx);
    float *moved = take_floats(code_size);
    float *d_code = take_floats(code_size);
    planes ones = planes_create(n);
    views v[METHODS];
    row rows[METHODS];
    dist_stats stats[METHODS];
    for (size_t i = 0; i < n; i++) { ones.depth[i] = ones.silhouette[i] = 1; }
    for (int m = 0; m < METHODS; m++) {
        dist_render_desc how = how_of(m);
        memset(&v[m], 0, sizeof v[m]);
        v[m].p = planes_create(n);
        rows[m] = *what;
        rows[m].method = m;
        for (int i = 0; i < what->views; i++) {
            const float turn[3] = {0, 2 * PI * (float)i / (float)what->views, 0};
            v[m].camera[i] = bench_camera(&field, what->resolution, what->resolution);
            dist_camera_move(&v[m].camera[i], turn, NULL);
            v[m].camera[i].translation[0] = v[m].camera[i].translation[1] = 0; /* the center stays in the middle */
            v[m].camera[i].translation[2] = 2.2f * field.radius;
            v[m].tape[i] = dist_tape_create(ctx, &v[m].camera[i], &how);
        }
    }
    check(ctx);
    for (int k = -1; k < runs; k++) { /* the first step has no picture to start from */
        rng random = rng_begin(3);
        for (size_t i = 0; i < code_size; i++) {
            moved[i] = code[i] * (1 + 2e-3f * (float)(k + 1) * (2 * rng_uniform(&random) - 1));
        }
        for (int m = 0; m < METHODS; m++) {
            double taken = step_once(ctx, shape, moved, what->views, &v[m], m, &ones, d_code, &stats[m]);
            if (k >= 0) { seconds[m][k] = taken; }
        }
    }
    for (int m = 0; m < METHODS; m++) {
        row_finish(&rows[m], (size_t)runs, seconds[m], &stats[m]);
        if (m) { compare(&v[PAPER].p, &v[m].p, n, (double)field.radius, &rows[m]); }
        for (int i = 0; i < what->views; i++) { dist_tape_destroy(v[m].tape[i]); }
    }
    add_rows(t, rows, METHODS, NULL);
    for (int m = 0; m < METHODS; m++) { planes_destroy(&v[m].p); }
    planes_destroy(&ones);
    free(moved);
    free(d_code);
    dist_shape_destroy(shape);
}

/* ---- sweeps ------------------------------------------------------------------------------------------------------ */

static dist_context *context_of(int threads)
{
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.workers = threads;
    dist_context *ctx = dist_context_create(&desc);
    check(ctx);
    return ctx;
}

/* One decoder's picture at sizes from `first` to `last`, on that many threads. */
static void run_decoder(const settings *set, const char *sweep, const grow_case *c, int first, int last, int threads,
                        table *t)
{
    dist_context *ctx = context_of(threads);
    dist_net *net = load_net_or_skip(ctx, c->net);
    if (net) {
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, c->code));
        check(ctx);
        for (int size = first; size <= last; size *= 2) {
            row what = {sweep, c->name, 0, size, net->layers - 1, net->layer[0].out, threads, 1, 0, 0,
                        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
            what.x = strcmp(sweep, "threads") == 0 ? threads : size;
            measure_picture(ctx, shape, size > 1024 ? set->runs / 3 + (set->runs < 3) : set->runs,
                            strcmp(sweep, "compact") == 0, &what, t);
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

/* f = 4 / width sum_k relu(d_k . p) - 0.5 with directions d_k spread evenly: the mean of relu(d . p) over the sphere is
   |p| / 4. The layers between pass on what they get. */
static dist_net *sphere_net(dist_context *ctx, int layers, int width)
{
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = layers;
    desc.width = width;
    desc.output_linear = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    check(ctx);
    float *weights = take_floats(dist_net_weight_count(net));
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        float *w = weights + layer->weight;
        for (int i = 0; i < layer->out; i++) {
            double z = 1 - (2 * i + 1) / (double)width;
            double around = 2.399963229728653 * i; /* the golden angle */
            float *of_unit = w + (size_t)i * (size_t)layer->in;
            if (l == 0) {
                of_unit[0] = (float)(sqrt(1 - z * z) * cos(around));
                of_unit[1] = (float)(sqrt(1 - z * z) * sin(around));
                of_unit[2] = (float)z;
            } else if (l + 1 < net->layers) {
                of_unit[i] = 1;
            } else {
                for (int k = 0; k < layer->in; k++) { of_unit[k] = 4.0f / (float)width; }
                weights[layer->bias] = -0.5f;
            }
        }
    }
    dist_net_set_weights(ctx, net, weights);
    check(ctx);
    free(weights);
    return net;
}

static void run_made(const settings *set, const char *sweep, const char *name, int layers, int width, table *t)
{
    int size = set->quick ? 128 : 256;
    dist_context *ctx = context_of(set->threads);
    dist_net *net = sphere_net(ctx, layers, width);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    check(ctx);
    row what = {sweep, name, 0, size, layers, width, set->threads, 1, 0, 0,
                0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    what.x = strcmp(sweep, "depth") == 0 ? layers : width;
    measure_picture(ctx, shape, set->runs, 0, &what, t);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

static void run_views(const settings *set, const grow_case *c, table *t)
{
    int size = set->quick ? 128 : 256;
    dist_context *ctx = context_of(set->threads);
    dist_net *net = load_net_or_skip(ctx, c->net);
    for (int count = 1; net && count <= MOST_VIEWS; count *= 2) {
        row what = {"views", c->name, 0, size, net->layers - 1, net->layer[0].out, set->threads, count, 0, count,
                    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
        measure_views(ctx, net, dist_net_code(net, c->code), set->runs, &what, t);
    }
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* As many threads as OpenMP would take; 1 without it. */
static int threads_most(void)
{
    dist_context *ctx = context_of(0);
    int most = dist_context_workers(ctx);
    dist_context_destroy(ctx);
    return most;
}

static void run_sweep(const settings *set, const char *sweep, table *t)
{
    static const int widths[] = {32, 64, 128, 256, 512}, depths[] = {2, 4, 8, 16};
    if (strcmp(sweep, "width") == 0) {
        for (int k = 0; k < 5; k++) { run_made(set, sweep, "sphere, 4 layers", 4, widths[k], t); }
    } else if (strcmp(sweep, "depth") == 0) {
        for (int k = 0; k < 4; k++) { run_made(set, sweep, "sphere, 128 wide", depths[k], 128, t); }
    } else {
        int most = threads_most();
        for (int i = 0; i < COMPACT; i++) {
            const grow_case *c = &compact[i];
            if (set->quick && !c->in_quick) { continue; }
            if (strcmp(sweep, "resolution") == 0 && i % 3 == 0 && (i < 6 || !set->quick)) {
                run_decoder(set, sweep, c, 64, 2048, set->threads, t);
            } else if (strcmp(sweep, "compact") == 0) {
                run_decoder(set, sweep, c, 1024, 1024, set->threads, t);
            } else if (strcmp(sweep, "threads") == 0 && i % 3 == 0) {
                for (int k = 1; k < most; k *= 2) { run_decoder(set, sweep, c, 512, 512, k, t); }
                run_decoder(set, sweep, c, 512, 512, most, t);
            } else if (strcmp(sweep, "views") == 0 && (i == 0 || (i == COMPACT - 1 && !set->quick))) {
                run_views(set, c, t);
            }
        }
    }
}

/* ---- plots and sums ---------------------------------------------------------------------------------------------- */

static double queries_per_pixel(const row *r)
{
    return r->queries / ((double)r->resolution * r->resolution * r->views);
}

typedef struct sweep_text {
    const char *name, *title, *x_label;
    int flags;
} sweep_text;

static const sweep_text sweeps[] = {
    {"resolution", "Cost against resolution", "pixels along a side", PLOT_LOG_X | PLOT_TWO_X},
    {"width", "Cost against the width of the network", "units of a layer", PLOT_LOG_X | PLOT_TWO_X},
    {"depth", "Cost against the depth of the network", "hidden layers", PLOT_LOG_X | PLOT_TWO_X},
    {"threads", "Cost against threads, 512 x 512", "threads", PLOT_WHOLE_X},
    {"views", "A step of an optimization against the number of views", "views", PLOT_LOG_X | PLOT_TWO_X},
    {"compact", "Our tracer beside the paper's at 1024 x 1024, compact shapes", NULL, 0},
};
enum { SWEEPS = sizeof sweeps / sizeof sweeps[0] };

/* "fox: guarded", kept until the program ends. */
static const char *series_name(const row *r)
{
    static char names[MOST_ROWS][64];
    static int used;
    char name[64];
    snprintf(name, sizeof name, "%.40s: %s", r->name, method_names[r->method]);
    for (int i = 0; i < used; i++) {
        if (strcmp(names[i], name) == 0) { return names[i]; }
    }
    memcpy(names[used], name, sizeof name);
    return names[used++];
}

static void plot_sweep(const settings *set, const sweep_text *s, const table *t)
{
    char subtitle[160] = "", file[64], path[PATH_SIZE];
    plot p = plot_begin(s->title, subtitle, 3);
    plot_panel *seconds = plot_add_panel(&p, "time", s->x_label, "seconds", s->flags | PLOT_LOG_Y);
    plot_add_panel(&p, "queries", s->x_label, "queries per pixel and view", s->flags | PLOT_LOG_Y);
    plot_add_panel(&p, "speed beside the paper's tracer", s->x_label, "times as fast",
                   s->flags | PLOT_ZERO_Y);
    seconds = p.panels; /* adding has moved them */
    plot_panel *queries = p.panels + 1, *ratio = p.panels + 2;
    for (size_t i = 0; i < t->n; i++) {
        const row *r = &t->rows[i];
        if (strcmp(r->sweep, s->name) != 0) { continue; }
        const char *name = series_name(r);
        plot_series *line = plot_series_of(seconds, name);
        line->dashed = r->method == PAPER;
        plot_point *q = plot_add(line, r->x, r->seconds);
        q->y_low = r->fastest, q->y_high = r->slowest;
        line = plot_series_of(queries, name);
        line->dashed = r->method == PAPER;
        plot_add(line, r->x, queries_per_pixel(r));
        if (r->method != PAPER) { plot_add(plot_series_of(ratio, name), r->x, r->speed_ratio); }
    }
    if (strcmp(s->name, "resolution") == 0) { ratio->guide = 8, ratio->guide_text = "goal at 1024"; }
    snprintf(subtitle, sizeof subtitle, "the paper's tracer: coarse to fine, 50 steps; median of %d or more runs, bars "
             "from the fastest to the slowest", set->runs);
    snprintf(file, sizeof file, "_%s.svg", s->name);
    plot_write(&p, path_of(path, set->svg, file), bench_origin());
}

static void plot_compact(const settings *set, const sweep_text *s, const table *t)
{
    char path[PATH_SIZE];
    plot p = plot_begin(s->title, "depth and mask, the two tracers in turn; the paper's: coarse to fine, 50 steps", 1);
    plot_panel *a = plot_add_panel(&p, "ratios", "paper's / ours", NULL, 0);
    p.panel_width = 420;
    a->guide = 8;
    a->guide_text = "goal";
    for (size_t i = 0; i < t->n; i++) {
        const row *r = &t->rows[i];
        if (strcmp(r->sweep, s->name) != 0 || r->method != GUARDED) { continue; }
        double y = plot_category(a, r->name);
        plot_series *line = plot_series_of(a, "ratio of times");
        line->no_line = 1;
        plot_add(line, r->speed_ratio, y)->open = r->speed_ratio < 8;
        line = plot_series_of(a, "ratio of times, the paper's with all units");
        line->no_line = 1;
        plot_add(line, r->dense_ratio, y)->open = r->dense_ratio < 8;
        line = plot_series_of(a, "ratio of queries");
        line->no_line = 1;
        plot_add(line, r->query_ratio, y)->open = r->query_ratio < 8;
    }
    for (size_t i = 0; i < t->n; i++) {
        const row *r = &t->rows[i];
        if (strcmp(r->sweep, s->name) != 0 || r->method != COARSE) { continue; }
        plot_series *line = plot_series_of(a, "ratio of times at the paper's error");
        line->no_line = 1;
        plot_add(line, r->speed_ratio, plot_category(a, r->name))->open = r->speed_ratio < 8;
    }
    p.open_means = "below the goal";
    plot_write(&p, path_of(path, set->svg, "_compact.svg"), bench_origin());
}

/* Where the goal is reached and where not; and every row where ours is slower. */
static void print_sums(const table *t)
{
    double least = 1e30, product = 0, least_dense = 1e30, dense = 0, least_coarse = 1e30, coarse = 0, count = 0;
    double coarse_count = 0;
    for (size_t i = 0; i < t->n; i++) {
        const row *r = &t->rows[i];
        if (r->method != PAPER && r->method != DENSE && r->speed_ratio < 1) {
            fprintf(stderr, "slower than the paper's tracer: %s, %s of %g, %s: %.2f of its speed\n", r->name, r->sweep,
                    r->x, method_names[r->method], r->speed_ratio);
        }
        if (strcmp(r->sweep, "compact") != 0) { continue; }
        if (r->method == COARSE) {
            least_coarse = fmin(least_coarse, r->speed_ratio);
            coarse += log(r->speed_ratio);
            coarse_count++;
        }
        if (r->method != GUARDED) { continue; }
        least = fmin(least, r->speed_ratio);
        product += log(r->speed_ratio);
        least_dense = fmin(least_dense, r->dense_ratio);
        dense += log(r->dense_ratio);
        count += 1;
    }
    if (count > 0) {
        fprintf(stderr, "%.0f compact shapes at 1024 x 1024: %.1f times the speed of the paper's tracer (geometric "
                "mean), %.1f at least; at the paper's error %.1f, %.1f at least; of the paper's with all units %.1f, "
                "%.1f at least; goal 8\n", count, exp(product / count), least,
                coarse_count > 0 ? exp(coarse / coarse_count) : 0, coarse_count > 0 ? least_coarse : 0,
                exp(dense / count), least_dense);
    }
}

int main(int argc, char **argv)
{
    settings set = {NULL, NULL, 1, 0, 0};
    table t = {NULL, 0};
    char path[PATH_SIZE];
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--sweep")) {
            set.sweep = option_text(&o);
        } else if (option_is(&o, "--svg")) {
            set.svg = option_text(&o);
            check_path(path_of(path, set.svg, ".svg"));
        } else if (option_is(&o, "--threads")) {
            set.threads = option_int(&o, 1, 256);
        } else if (option_is(&o, "--runs")) {
            set.runs = option_int(&o, 1, MOST_RUNS);
        } else if (option_is(&o, "--quick")) {
            set.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    if (!set.runs) { set.runs = set.quick ? 3 : 7; }
    t.rows = (row *)take(MOST_ROWS, sizeof *t.rows);
    puts("sweep,case,method,resolution,layers,width,threads,views,queries,queries_per_pixel,operations,operations_done,"
         "seconds,seconds_min,seconds_max,runs,hits,speed_ratio,query_ratio,differs_per_mille,apart,speed_ratio_dense,"
         "epsilon,mean_error,p99_error,wrong");
    int known = 0;
    for (int i = 0; i < SWEEPS; i++) {
        if (set.sweep && strcmp(set.sweep, sweeps[i].name) != 0) { continue; }
        known = 1;
        run_sweep(&set, sweeps[i].name, &t);
        if (!set.svg) { continue; }
        if (sweeps[i].x_label) {
            plot_sweep(&set, &sweeps[i], &t);
        } else {
            plot_compact(&set, &sweeps[i], &t);
        }
    }
    if (!known) { fail("no sweep is called %s", set.sweep); }
    print_sums(&t);
    free(t.rows);
    return 0;
}
