/* SPDX-License-Identifier: MIT-0
   results_completion.c - shape completion from one depth picture, and how such fits go: the paper's table of shape
   completion by three methods, its loss curves with each acceleration on and off, how the loss on the picture goes
   with the distance of the shapes, and the gradients (K = 1, 3, 5; paper, implicit, normal) by what they need to reach
   a given distance. Writes completion*.csv, completion*.svg and completion*.md into --out.

   The decoder is the embedded one, trained by examples/train.c on 64 shapes each of four families of examples/shapes.h.
   The shapes that are completed are of the same families and were never trained on. A fit starts at its family's mean
   code and its prior is the distance from there: where a decoder knows one family only, that is the zero code.
   Fits run beside each other, one thread each; the results are the same for any number of threads. Seconds are of the
   thread's own processor time where the system counts it. */
#define _POSIX_C_SOURCE 200112L /* clock_gettime */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "../examples/fit.h"
#include "../examples/shapes.h"
#include "bench.h"
#include "plot.h"
#include "results.h"
#include <time.h>
#ifdef _OPENMP
#include <omp.h>
#endif

static const char usage[] =
    "results_completion [options]: completion, completion_silhouette, completion_curves, completion_gradients\n"
    RESULTS_USAGE
    "  --shapes N         held-out shapes of each family in the table (default 20)\n"
    "  --first N          number of the first of them (default 1000; from there on none was trained on)\n"
    "  --size N           pixels along a side of the table's pictures (default 96)\n"
    "  --threads N        fits at a time (default all cores)\n";

typedef struct settings {
    results r;
    int shapes, first, size, threads, iterations;
} settings;

/* ---- fits beside each other -------------------------------------------------------------------------------------- */

typedef struct worker {
    dist_context *ctx;
    dist_shape *shape;
    dist_field field;
} worker;

typedef struct bench {
    settings s;
    dist_context *ctx;
    dist_net *net;
    size_t code_size;
    int worker_count;
    worker *workers;
} bench;

static bench bench_create(const settings *s)
{
    bench b;
    dist_context_desc desc;
    memset(&b, 0, sizeof b);
    memset(&desc, 0, sizeof desc);
    desc.workers = 1;
    b.s = *s;
    b.ctx = dist_context_create(&desc);
    b.net = load_model(b.ctx, "embedded");
    b.code_size = (size_t)dist_net_code_size(b.net);
    b.worker_count = 1;
#ifdef _OPENMP
    b.worker_count = s->threads ? s->threads : omp_get_max_threads();
#endif
    b.workers = (worker *)take((size_t)b.worker_count, sizeof *b.workers);
    for (int i = 0; i < b.worker_count; i++) {
        worker *w = &b.workers[i];
        w->ctx = dist_context_create(&desc);
        w->shape = dist_shape_create(w->ctx, b.net, NULL);
        check(w->ctx);
        w->field = dist_shape_field(w->shape);
    }
    return b;
}

static void bench_destroy(bench *b)
{
    for (int i = 0; i < b->worker_count; i++) {
        dist_shape_destroy(b->workers[i].shape);
        dist_context_destroy(b->workers[i].ctx);
    }
    free(b->workers);
    dist_net_destroy(b->net);
    dist_context_destroy(b->ctx);
}

typedef void (*job_fn)(const bench *b, worker *w, int index, void *user);

/* Every job writes to a place of its own, so that their order does not matter. */
static void run_jobs(const bench *b, const char *what, int count, job_fn job, void *user)
{
    progress p = progress_begin(what);
    int done = 0;
#ifdef _OPENMP
#pragma omp parallel for schedule(dynamic, 1) num_threads(b->worker_count)
#endif
    for (int i = 0; i < count; i++) {
        int me = 0;
#ifdef _OPENMP
        me = omp_get_thread_num();
#endif
        job(b, &b->workers[me], i, user);
#ifdef _OPENMP
#pragma omp critical
#endif
        progress_show(&p, ++done, count, NULL, 0);
    }
    progress_end(&p);
}

/* ---- what is seen ------------------------------------------------------------------------------------------------ */

/* One shape of a family, one picture of it, and points all over its true surface. */
typedef struct problem {
    int family;
    unsigned index;
    dist_camera camera;
    observation seen;
    float *points, *normals; /* (n, 3), world: where each ray hits and the true normal there */
    float *surface;          /* (SURFACE_POINTS, 3) */
    float *start;            /* its family's mean code */
} problem;

/* The cameras of the paper's pictures: any side, 25 to 30 degrees above. */
static dist_camera problem_camera(int size, int family, unsigned index)
{
    rng r = rng_begin(7919ULL * (unsigned)family + index);
    view v = view_default(size, size);
    float azimuth = 2.0f * PI * rng_uniform(&r);
    float elevation = (25.0f + 5.0f * rng_uniform(&r)) * PI / 180.0f;
    v.eye[0] = 2.4f * cosf(elevation) * sinf(azimuth);
    v.eye[1] = 2.4f * sinf(elevation);
    v.eye[2] = 2.4f * cosf(elevation) * cosf(azimuth);
    return view_camera(&v, 0.0f);
}

/* In the middle of its family. */
static float *family_mean(const dist_net *net, int family)
{
    size_t n = (size_t)dist_net_code_size(net);
    int count = dist_net_code_count(net) / SHAPE_FAMILIES;
    float *mean = take_floats(n);
    for (int i = 0; i < count; i++) {
        const float *code = dist_net_code(net, family * count + i);
        for (size_t j = 0; j < n; j++) {
            mean[j] += code[j] / (float)count;
        }
    }
    return mean;
}

static problem problem_create(const bench *b, worker *w, int size, int family, unsigned index)
{
    problem p;
    shape truth;
    dist_field field;
    dist_images out;
    dist_render_desc how;
    memset(&p, 0, sizeof p);
    memset(&out, 0, sizeof out);
    memset(&how, 0, sizeof how);
    p.family = family;
    p.index = index;
    p.camera = problem_camera(size, family, index);
    p.seen = observation_create(size, size);
    p.points = take_floats(3 * p.seen.n);
    p.normals = take_floats(3 * p.seen.n);
    p.start = family_mean(b->net, family);
    float *distance = take_floats(p.seen.n);
    shape_make(&truth, family, index);
    field = shape_field(&truth);
    how.normal_space = DIST_SPACE_WORLD;
    out.depth = p.seen.depth;
    out.distance = distance;
    out.normal = p.normals;
    out.mask = p.seen.mask;
    dist_render(w->ctx, &field, &p.camera, &how, &out, NULL);
    check(w->ctx);
    for (size_t i = 0; i < p.seen.n; i++) {
        float origin[3], direction[3];
        if (!p.seen.mask[i]) { p.seen.depth[i] = 0.0f; }
        dist_camera_ray(&p.camera, (float)(i % (size_t)size), (float)(i / (size_t)size), origin, direction);
        for (size_t k = 0; k < 3; k++) {
            p.points[3 * i + k] = origin[k] + distance[i] * direction[k];
        }
    }
    dist_mesh *mesh = surface_of(w->ctx, &field, &p.surface);
    dist_mesh_destroy(mesh);
    free(distance);
    return p;
}

static void problem_destroy(problem *p)
{
    observation_destroy(&p->seen);
    free(p->points);
    free(p->normals);
    free(p->surface);
    free(p->start);
}

typedef struct sparsity {
    const char *name;
    double percent;
    int points;
} sparsity;

enum { SPARSITIES = 6 };
static const sparsity sparsities[SPARSITIES] = {{"dense", 100, 0},        {"50 %", 50, 0},
                                                {"10 %", 10, 0},          {"100 points", 100, 100},
                                                {"50 points", 100, 50},   {"20 points", 100, 20}};

/* Fewer points are some of the more: the same shuffle for every number. */
static void problem_keep(problem *p, const sparsity *how_much)
{
    memset(p->seen.seen, 0, p->seen.n * sizeof(float));
    observation_keep(&p->seen, how_much->percent, how_much->points, 31u * p->index + (unsigned)p->family);
}

/* ---- the fits ---------------------------------------------------------------------------------------------------- */

/* What the silhouette's loss is a mean over: dist_loss_silhouette's all pixels, or dist_loss_silhouette_wrong's. */
enum { SILHOUETTE_NONE, SILHOUETTE_ALL, SILHOUETTE_WRONG };

/* samples: DeepSDF's way; else through the renderer. */
typedef struct recipe {
    const char *name;
    int samples, silhouette; /* silhouette: SILHOUETTE_* */
    dist_render_desc how;
    float weights[3], rate; /* depth, silhouette, prior */
    int iterations;
} recipe;

/* What a fit leaves behind; NULL where it is not wanted. */
typedef struct trail {
    float *path;     /* (iterations + 1, code_size) */
    double *image;   /* (iterations): weighted loss on the picture, without the prior */
    double *seconds; /* (iterations + 1), all so far */
    double *queries; /* (iterations + 1) */
} trail;

static trail trail_create(const bench *b, int iterations)
{
    size_t n = (size_t)iterations + 1;
    trail t;
    t.path = take_floats(n * b->code_size);
    t.image = (double *)take(3 * n, sizeof *t.image);
    t.seconds = t.image + n;
    t.queries = t.seconds + n;
    return t;
}

static void trail_destroy(trail *t)
{
    free(t->path);
    free(t->image);
}

/* weight * mean of (code - start)^2; adds its gradient. */
static void prior(size_t n, const float *code, const float *start, float weight, float *d_code)
{
    for (size_t j = 0; j < n; j++) {
        d_code[j] += 2.0f * weight / (float)n * (code[j] - start[j]);
    }
}

/* One step's loss on the picture and its gradient in d_code, by the renderer. */
typedef struct picture_loss {
    dist_images out, d_out;
    dist_tape *tape;
    dist_render_desc how;
    unsigned char *pixels;
} picture_loss;

static picture_loss picture_loss_create(worker *w, const problem *p, const recipe *r)
{
    picture_loss l;
    size_t n = p->seen.n;
    memset(&l, 0, sizeof l);
    l.how = r->how;
    l.out.depth = take_floats(n);
    l.d_out.depth = take_floats(n);
    l.out.mask = (unsigned char *)take(n, 1);
    l.tape = dist_tape_create(w->ctx, &p->camera, &l.how);
    if (r->silhouette) {
        l.out.silhouette = take_floats(n);
        l.d_out.silhouette = take_floats(n);
        return l;
    }
    l.pixels = (unsigned char *)take(n, 1); /* no ray that nobody looks at */
    for (size_t i = 0; i < n; i++) {
        l.pixels[i] = p->seen.seen[i] > 0.0f;
    }
    l.how.pixels = l.pixels;
    return l;
}

static void picture_loss_destroy(picture_loss *l)
{
    dist_tape_destroy(l->tape);
    free(l->out.depth);
    free(l->d_out.depth);
    free(l->out.mask);
    free(l->out.silhouette);
    free(l->d_out.silhouette);
    free(l->pixels);
}

static double picture_loss_step(worker *w, const problem *p, const recipe *r, picture_loss *l, dist_stats *stats,
                                float *d_code)
{
    size_t n = p->seen.n;
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = d_code;
    l->out.stats = l->d_out.stats = stats;
    dist_render(w->ctx, &w->field, &p->camera, &l->how, &l->out, l->tape);
    memset(l->d_out.depth, 0, n * sizeof(float));
    double loss =
        (double)dist_loss_depth(n, l->out.depth, p->seen.seen, l->out.mask, r->weights[0], l->d_out.depth);
    if (r->silhouette) {
        memset(l->d_out.silhouette, 0, n * sizeof(float));
        loss += r->silhouette == SILHOUETTE_WRONG
                    ? (double)dist_loss_silhouette_wrong(n, l->out.silhouette, p->seen.mask, r->weights[1],
                                                         l->d_out.silhouette)
                    : (double)dist_loss_silhouette(n, l->out.silhouette, p->seen.mask, r->weights[1],
                                                   l->d_out.silhouette);
    }
    dist_render_backward(w->ctx, l->tape, &l->d_out, &grads);
    check(w->ctx);
    return loss;
}

/* DeepSDF's: no picture, but points whose distance is taken to be known. From each observed point x with its true
   normal n, as in the authors' code for this comparison, with e uniform in (0, SAMPLE_REACH):
       |clamp(f(x + e n)) - e| + |clamp(f(x - e n)) + e|    (mean over the points)
   and from a random place before x on its ray, which is empty,
       max(0, -f)                                           (mean likewise) */
#define SAMPLE_REACH 0.01f
enum { SAMPLE_BATCH = 2048 };

typedef struct sample_loss {
    size_t count;    /* observed pixels used in a step */
    size_t *pixels;  /* all observed */
    size_t observed;
    float *points, *target, *d_sdf, *loss; /* three points a pixel; the third is the empty place */
    float scale;
    rng random;
} sample_loss;

static sample_loss sample_loss_create(const problem *p)
{
    sample_loss l;
    memset(&l, 0, sizeof l);
    l.pixels = (size_t *)take(p->seen.n, sizeof *l.pixels);
    for (size_t i = 0; i < p->seen.n; i++) {
        if (p->seen.seen[i] > 0.0f) { l.pixels[l.observed++] = i; }
    }
    l.count = l.observed < SAMPLE_BATCH ? l.observed : SAMPLE_BATCH;
    l.points = take_floats(18 * l.count);
    l.target = l.points + 9 * l.count;
    l.d_sdf = l.target + 3 * l.count;
    l.loss = l.d_sdf + 3 * l.count;
    l.random = rng_begin(p->index);
    return l;
}

static void sample_loss_destroy(sample_loss *l)
{
    free(l->pixels);
    free(l->points);
}

static void sample_loss_seed(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                             float *d_sdf)
{
    const float clamp = 0.1f;
    sample_loss *l = (sample_loss *)user;
    (void)gradient;
    for (size_t i = 0; i < count; i++) {
        size_t at = first + i;
        float f = sdf[i] < -clamp ? -clamp : sdf[i] > clamp ? clamp : sdf[i];
        float error = at % 3 < 2 ? f - l->target[at] : f < 0.0f ? f : 0.0f;
        l->loss[at] = fabsf(error);
        d_sdf[i] = error > 0.0f ? l->scale : error < 0.0f ? -l->scale : 0.0f;
    }
}

static double sample_loss_step(worker *w, const problem *p, const recipe *r, sample_loss *l, float *d_code)
{
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = d_code;
    for (size_t i = 0; i < l->count; i++) {
        size_t other = i + (l->count < l->observed ? rng_index(&l->random, l->observed - i) : 0);
        size_t pixel = l->pixels[other];
        l->pixels[other] = l->pixels[i];
        l->pixels[i] = pixel;
        const float *x = p->points + 3 * pixel, *normal = p->normals + 3 * pixel;
        float origin[3], direction[3];
        float *to = l->points + 9 * i;
        dist_camera_ray(&p->camera, (float)(pixel % (size_t)p->seen.width), (float)(pixel / (size_t)p->seen.width),
                        origin, direction);
        float along = 0.0f, squared = -w->field.radius * w->field.radius;
        for (int k = 0; k < 3; k++) {
            along -= origin[k] * direction[k];
            squared += origin[k] * origin[k];
        }
        float entry = along - sqrtf(along * along - squared > 0.0f ? along * along - squared : 0.0f);
        float off = SAMPLE_REACH * rng_uniform(&l->random);
        float share = rng_uniform(&l->random);
        for (int k = 0; k < 3; k++) {
            float enters = origin[k] + entry * direction[k];
            to[k] = x[k] + off * normal[k];
            to[3 + k] = x[k] - off * normal[k];
            to[6 + k] = enters + share * (x[k] - enters);
        }
        l->target[3 * i] = off;
        l->target[3 * i + 1] = -off;
    }
    l->scale = r->weights[0] / (float)l->count;
    dist_field_backward(w->ctx, &w->field, 3 * l->count, l->points, l->d_sdf, sample_loss_seed, l, NULL, &grads);
    check(w->ctx);
    double sum = 0;
    for (size_t i = 0; i < 3 * l->count; i++) {
        sum += (double)l->loss[i];
    }
    return sum * (double)l->scale;
}

/* Moves code from the problem's start; t may be NULL. Returns seconds; *queries: points at which f was asked. */
static double fit_code(const bench *b, worker *w, const problem *p, const recipe *r, float *code, double *queries,
                       trail *t)
{
    size_t n = b->code_size;
    float *d_code = take_floats(n);
    picture_loss picture;
    sample_loss samples;
    dist_stats stats;
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.rate = r->rate;
    adam.moments = take_floats(2 * n);
    memcpy(code, p->start, n * sizeof(float));
    *queries = 0;
    double begin = thread_seconds();
    if (r->samples) {
        samples = sample_loss_create(p);
    } else {
        picture = picture_loss_create(w, p, r);
    }
    for (int i = 0; i < r->iterations; i++) {
        memset(d_code, 0, n * sizeof(float));
        memset(&stats, 0, sizeof stats);
        dist_shape_set_code(w->shape, code);
        double image = r->samples ? sample_loss_step(w, p, r, &samples, d_code)
                                  : picture_loss_step(w, p, r, &picture, &stats, d_code);
        prior(n, code, p->start, r->weights[2], d_code);
        if (t) {
            memcpy(t->path + (size_t)i * n, code, n * sizeof(float));
            t->image[i] = image;
        }
        dist_adam_step(&adam, n, code, d_code);
        *queries += r->samples ? 3.0 * (double)samples.count : (double)(stats.queries + stats.backward_points);
        if (t) {
            t->seconds[i + 1] = thread_seconds() - begin;
            t->queries[i + 1] = *queries;
        }
    }
    double seconds = thread_seconds() - begin;
    if (t) { memcpy(t->path + (size_t)r->iterations * n, code, n * sizeof(float)); }
    if (r->samples) {
        sample_loss_destroy(&samples);
    } else {
        picture_loss_destroy(&picture);
    }
    free(adam.moments);
    free(d_code);
    return seconds;
}

/* x 1000, as the paper reports it; infinity where the code has no surface. */
static double chamfer_of(worker *w, const problem *p, const float *code)
{
    float *points = NULL;
    dist_shape_set_code(w->shape, code);
    dist_mesh *mesh = surface_of(w->ctx, &w->field, &points);
    double chamfer = chamfer_between(w->ctx, points, p->surface);
    dist_mesh_destroy(mesh);
    free(points);
    return chamfer < 0 ? (double)INFINITY : 1000.0 * chamfer;
}

/* ---- tables ------------------------------------------------------------------------------------------------------ */

static recipe recipe_make(const bench *b, const char *name, int samples, int silhouette)
{
    recipe r;
    memset(&r, 0, sizeof r);
    r.name = name;
    r.samples = samples;
    r.silhouette = silhouette;
    r.weights[0] = 10.0f;
    r.weights[1] = 1.0f;
    r.weights[2] = 1.0f;
    r.rate = 0.01f;
    r.iterations = b->s.iterations;
    r.how.warm_start = 1;
    return r;
}

static void print_value(FILE *f, double value, int best)
{
    if (!(value < 1e30)) {
        fputs(" none |", f);
    } else {
        fprintf(f, best ? " **%.2f** |" : " %.2f |", value);
    }
}

static void csv_number(FILE *f, double value)
{
    if (value < 1e30) {
        fprintf(f, ",%.6g", value);
    } else {
        fputs(",none", f);
    }
}

enum { FAMILIES = 3, MOST_RECIPES = 6 }; /* sofas, planes, tables */

typedef struct cell {
    double points, chamfer, seconds, queries;
} cell;

/* Every shape by every recipe under every sparsity. */
typedef struct grid {
    int shapes, sparsity_count, recipe_count;
    const sparsity *sparsities;
    recipe recipes[MOST_RECIPES];
    cell *cells;   /* (FAMILIES, shapes, sparsity_count, recipe_count) */
    double *start; /* (FAMILIES, shapes): of the mean shape */
} grid;

static cell *grid_cell(const grid *g, int family, int i, int k, int m)
{
    return &g->cells[((family * g->shapes + i) * g->sparsity_count + k) * g->recipe_count + m];
}

static void grid_job(const bench *b, worker *w, int index, void *user)
{
    grid *g = (grid *)user;
    int family = index % FAMILIES; /* so that what takes long is spread evenly */
    int i = index / FAMILIES;
    problem p = problem_create(b, w, b->s.size, family, (unsigned)(b->s.first + i));
    float *code = take_floats(b->code_size);
    g->start[family * g->shapes + i] = chamfer_of(w, &p, p.start);
    for (int k = 0; k < g->sparsity_count; k++) {
        problem_keep(&p, &g->sparsities[k]);
        for (int m = 0; m < g->recipe_count; m++) {
            cell *to = grid_cell(g, family, i, k, m);
            to->seconds = fit_code(b, w, &p, &g->recipes[m], code, &to->queries, NULL);
            to->chamfer = chamfer_of(w, &p, code);
            to->points = (double)p.seen.seen_count;
        }
    }
    free(code);
    problem_destroy(&p);
}

static void grid_run(const bench *b, grid *g, const char *name)
{
    int count = FAMILIES * g->shapes;
    g->cells = (cell *)take((size_t)(count * g->sparsity_count * g->recipe_count), sizeof *g->cells);
    g->start = (double *)take((size_t)count, sizeof *g->start);
    run_jobs(b, name, count, grid_job, g);
    FILE *f = results_csv(&b->s.r, name, "family,shape,observation,points,method,chamfer_x1000,queries,cpu_seconds");
    for (int i = 0; i < count; i++) {
        const char *family = shape_family_name(i / g->shapes);
        int index = b->s.first + i % g->shapes;
        fprintf(f, "%s,%d,none,0,mean shape", family, index);
        csv_number(f, g->start[i]);
        fputs(",0,0\n", f);
        for (int k = 0; k < g->sparsity_count; k++) {
            for (int m = 0; m < g->recipe_count; m++) {
                const cell *c = grid_cell(g, i / g->shapes, i % g->shapes, k, m);
                fprintf(f, "%s,%d,%s,%.0f,\"%s\"", family, index, g->sparsities[k].name, c->points,
                        g->recipes[m].name);
                csv_number(f, c->chamfer);
                fprintf(f, ",%.0f,%.3f\n", c->queries, c->seconds);
            }
        }
    }
    results_close(&b->s.r, f, name, ".csv");
}

static void grid_destroy(grid *g)
{
    free(g->cells);
    free(g->start);
}

static double grid_median(const grid *g, int family, int k, int m)
{
    double *v = (double *)take((size_t)g->shapes, sizeof *v);
    for (int i = 0; i < g->shapes; i++) {
        v[i] = grid_cell(g, family, i, k, m)->chamfer;
    }
    double result = results_median((size_t)g->shapes, v);
    free(v);
    return result;
}

static int grid_best(const grid *g, int family, int k)
{
    int best = 0;
    for (int m = 1; m < g->recipe_count; m++) {
        if (grid_median(g, family, k, m) < grid_median(g, family, k, best)) { best = m; }
    }
    return best;
}

static void grid_means(const grid *g, FILE *f)
{
    fputs("\n| a fit, mean of all | queries, thousands | processor seconds |\n|---|---|---|\n", f);
    for (int m = 0; m < g->recipe_count; m++) {
        double queries = 0, seconds = 0;
        int count = FAMILIES * g->shapes * g->sparsity_count;
        for (int i = 0; i < count; i++) {
            queries += g->cells[i * g->recipe_count + m].queries / count;
            seconds += g->cells[i * g->recipe_count + m].seconds / count;
        }
        fprintf(f, "| %s | %.0f | %.2f |\n", g->recipes[m].name, queries / 1000, seconds);
    }
}

/* ---- the paper's table ------------------------------------------------------------------------------------------- */

/* Median Chamfer distance x 1000 of the paper's table, (sofa, plane, table), (DeepSDF, ours, ours with mask). */
static const double published[FAMILIES][3][SPARSITIES] = {
    {{5.37, 5.56, 5.50, 5.93, 6.03, 7.63}, {4.12, 5.75, 5.49, 5.72, 5.57, 6.95}, {4.12, 3.98, 4.31, 3.98, 4.30, 4.94}},
    {{3.71, 3.73, 4.29, 4.44, 4.40, 5.39}, {2.18, 4.08, 4.81, 4.44, 4.51, 5.30}, {2.18, 2.08, 2.62, 2.26, 2.55, 3.60}},
    {{12.93, 12.78, 11.67, 12.87, 13.76, 15.77},
     {5.37, 12.05, 11.42, 11.70, 13.76, 15.83},
     {5.37, 5.15, 5.16, 5.26, 6.33, 7.62}}};

/* Over all cells: in how many the last recipe has the best median; and on how many shapes it beats recipe m. */
static void completion_words(const grid *g, FILE *f)
{
    int last = g->recipe_count - 1;
    int best = 0, cells = FAMILIES * g->sparsity_count, fits = cells * g->shapes;
    for (int i = 0; i < cells; i++) {
        best += grid_best(g, i / g->sparsity_count, i % g->sparsity_count) == last;
    }
    fprintf(f, "\nThe best median of the three is that of *%s* in %d of %d cells.", g->recipes[last].name, best, cells);
    for (int m = 0; m < last; m++) {
        int wins = 0;
        for (int i = 0; i < fits; i++) {
            const cell *c = &g->cells[i * g->recipe_count];
            wins += c[last].chamfer < c[m].chamfer;
        }
        fprintf(f, " It is nearer to the truth than *%s* in %d of %d fits.", g->recipes[m].name, wins, fits);
    }
    fputs("\n", f);
}

static void completion_markdown(const bench *b, const grid *g)
{
    const results *r = &b->s.r;
    FILE *f = results_section(r, "completion", "Shape completion from one depth picture", "build/results_completion");
    fprintf(f,
            "Median Chamfer distance x 1000 (as DeepSDF defines it, 30,000 points) over %d held-out shapes of each "
            "family,\n%d x %d pixels from any side, %d steps of Adam at 0.01 from the family's mean code, weights of "
            "depth, silhouette and\nprior 10, 1, 1. *DeepSDF* is its own fitting, as the paper's authors compare with it"
            ": samples up to 0.01 off the surface\nalong the true normals, which it is given, and in the free space"
            " before it. *Ours* is depth alone; it has no normals. In\n*(paper)*: the paper's median, of other"
            " shapes (200 of ShapeNet each) by other decoders: not the same quantity, to be\ncompared by the order of"
            " the rows only. Bold: the best of the three.\n\n",
            g->shapes, b->s.size, b->s.size, b->s.iterations);
    for (int family = 0; family < FAMILIES; family++) {
        fprintf(f, "| %s |", shape_family_name(family));
        for (int k = 0; k < g->sparsity_count; k++) {
            fprintf(f, " %s | (paper) |", g->sparsities[k].name);
        }
        fputs("\n|---|", f);
        for (int k = 0; k < g->sparsity_count; k++) {
            fputs("---|---|", f);
        }
        fputs("\n", f);
        for (int m = 0; m < g->recipe_count; m++) {
            fprintf(f, "| %s |", g->recipes[m].name);
            for (int k = 0; k < g->sparsity_count; k++) {
                print_value(f, grid_median(g, family, k, m), m == grid_best(g, family, k));
                fprintf(f, " (%.2f) |", published[family][m][k]);
            }
            fputs("\n", f);
        }
        double *start = (double *)take((size_t)g->shapes, sizeof *start);
        memcpy(start, g->start + family * g->shapes, (size_t)g->shapes * sizeof *start);
        fprintf(f, "\nBefore the fit (the mean shape): %.2f.\n\n", results_median((size_t)g->shapes, start));
        free(start);
    }
    completion_words(g, f);
    grid_means(g, f);
    fputs("\n![completion](completion.svg)\n", f);
    results_close(r, f, "completion", ".md");
}

static void completion_plot(const bench *b, const grid *g)
{
    char subtitle[160], path[PATH_SIZE];
    snprintf(subtitle, sizeof subtitle, "median and quartiles of %d held-out shapes each; %d steps", g->shapes,
             b->s.iterations);
    plot figure = plot_begin("Shape completion from one depth picture", subtitle, FAMILIES);
    double *v = (double *)take((size_t)g->shapes, sizeof *v);
    for (int family = 0; family < FAMILIES; family++) {
        plot_panel *panel = plot_add_panel(&figure, shape_family_name(family), "points seen",
                                           "Chamfer distance x 1000", PLOT_LOG_X | PLOT_LOG_Y);
        for (int m = 0; m < g->recipe_count; m++) {
            plot_series *s = plot_add_series(panel, g->recipes[m].name);
            for (int k = 0; k < g->sparsity_count; k++) {
                for (int i = 0; i < g->shapes; i++) {
                    v[i] = grid_cell(g, family, i, k, m)->points;
                }
                double points = results_median((size_t)g->shapes, v) * (1.0 + 0.06 * (m - 1)); /* side by side */
                for (int i = 0; i < g->shapes; i++) {
                    v[i] = grid_cell(g, family, i, k, m)->chamfer;
                }
                plot_point *q = plot_add(s, points, results_median((size_t)g->shapes, v));
                q->y_low = v[(g->shapes - 1) / 4];
                q->y_high = v[3 * (g->shapes - 1) / 4];
            }
        }
    }
    free(v);
    plot_write(&figure, path_of(path, results_stem(&b->s.r, "completion"), ".svg"), results_machine());
    puts(path);
}

static void completion(const bench *b)
{
    grid g;
    memset(&g, 0, sizeof g);
    g.shapes = b->s.shapes;
    g.sparsity_count = SPARSITIES;
    g.sparsities = sparsities;
    g.recipe_count = 3;
    g.recipes[0] = recipe_make(b, "DeepSDF", 1, SILHOUETTE_NONE);
    g.recipes[1] = recipe_make(b, "ours", 0, SILHOUETTE_NONE);
    g.recipes[2] = recipe_make(b, "ours with silhouette", 0, SILHOUETTE_WRONG);
    grid_run(b, &g, "completion");
    completion_markdown(b, &g);
    completion_plot(b, &g);
    grid_destroy(&g);
}

/* ---- what the silhouette's loss is a mean over ------------------------------------------------------------------- */

static void silhouettes(const bench *b)
{
    static const sparsity some[3] = {{"dense", 100, 0}, {"100 points", 100, 100}, {"20 points", 100, 20}};
    const char *name = "completion_silhouette";
    grid g;
    memset(&g, 0, sizeof g);
    g.shapes = (b->s.shapes + 3) / 4;
    g.sparsity_count = 3;
    g.sparsities = some;
    g.recipe_count = 4;
    g.recipes[0] = recipe_make(b, "none", 0, SILHOUETTE_NONE);
    g.recipes[1] = recipe_make(b, "all pixels, weight 1", 0, SILHOUETTE_ALL);
    g.recipes[2] = recipe_make(b, "wrong pixels, weight 1", 0, SILHOUETTE_WRONG);
    g.recipes[3] = recipe_make(b, "wrong pixels, weight 10", 0, SILHOUETTE_WRONG);
    g.recipes[3].weights[1] = 10.0f;
    grid_run(b, &g, name);
    FILE *f = results_section(&b->s.r, name, "What the silhouette's loss is a mean over", "build/results_completion");
    fprintf(f,
            "The paper's equation 8 does not say over which pixels it is summed or averaged. Its authors' code takes "
            "the mean over\nthe pixels that wrongly miss plus the mean over those that wrongly hit; as a mean over all"
            " pixels the same loss has\nlittle weight against the depth's. Median Chamfer distance x 1000, the first"
            " %d shapes of each family, else as above.\n\n|",
            g.shapes);
    for (int family = 0; family < FAMILIES; family++) {
        for (int k = 0; k < g.sparsity_count; k++) {
            fprintf(f, " | %s, %s", shape_family_name(family), some[k].name);
        }
    }
    fputs(" |\n|---|", f);
    for (int i = 0; i < FAMILIES * g.sparsity_count; i++) {
        fputs("---|", f);
    }
    for (int m = 0; m < g.recipe_count; m++) {
        fprintf(f, "\n| %s |", g.recipes[m].name);
        for (int family = 0; family < FAMILIES; family++) {
            for (int k = 0; k < g.sparsity_count; k++) {
                print_value(f, grid_median(&g, family, k, m), m == grid_best(&g, family, k));
            }
        }
    }
    fputs("\n", f);
    results_close(&b->s.r, f, name, ".md");
    grid_destroy(&g);
}

/* ---- the way of a fit -------------------------------------------------------------------------------------------- */

enum { MOST_CHECKS = 64 };

/* Some problems by some recipes from dense depth and silhouette, with the whole way kept and the distance of the
   shapes measured at some steps of it. */
typedef struct ways {
    int size, problems, recipe_count, check_count;
    int only; /* above 0: the recipe that is measured at every check, the others at the last alone */
    int checks[MOST_CHECKS];
    recipe recipes[MOST_RECIPES];
    trail *trails;   /* (problems, recipe_count) */
    double *chamfer; /* (problems, recipe_count, check_count) */
} ways;

static void ways_job(const bench *b, worker *w, int index, void *user)
{
    ways *v = (ways *)user;
    int i = index / v->recipe_count;
    double queries;
    problem p = problem_create(b, w, v->size, i % FAMILIES, (unsigned)(b->s.first + i / FAMILIES));
    float *code = take_floats(b->code_size);
    trail *t = &v->trails[index];
    problem_keep(&p, &sparsities[0]);
    *t = trail_create(b, b->s.iterations);
    fit_code(b, w, &p, &v->recipes[index % v->recipe_count], code, &queries, t);
    int all = v->only <= 0 || index % v->recipe_count == v->only;
    for (int k = all ? 0 : v->check_count - 1; k < v->check_count; k++) {
        const float *there = t->path + (size_t)v->checks[k] * b->code_size;
        v->chamfer[index * v->check_count + k] = chamfer_of(w, &p, there);
    }
    free(code);
    problem_destroy(&p);
}

static void ways_run(const bench *b, ways *v, const char *name)
{
    int count = v->problems * v->recipe_count;
    v->trails = (trail *)take((size_t)count, sizeof *v->trails);
    v->chamfer = (double *)take((size_t)(count * v->check_count), sizeof *v->chamfer);
    run_jobs(b, name, count, ways_job, v);
    FILE *f = results_csv(&b->s.r, name, "family,shape,mode,step,image_loss,chamfer_x1000,queries,cpu_seconds");
    for (int j = 0; j < count; j++) {
        const trail *t = &v->trails[j];
        int i = j / v->recipe_count;
        for (int step = 0, k = 0; step <= b->s.iterations; step++) {
            fprintf(f, "%s,%d,\"%s\",%d,", shape_family_name(i % FAMILIES), b->s.first + i / FAMILIES,
                    v->recipes[j % v->recipe_count].name, step);
            if (step < b->s.iterations) { fprintf(f, "%.6g", t->image[step]); }
            int check = k < v->check_count && v->checks[k] == step;
            k += check;
            if (check && v->chamfer[j * v->check_count + k - 1] > 0) {
                csv_number(f, v->chamfer[j * v->check_count + k - 1]);
            } else {
                fputs(",", f);
            }
            fprintf(f, ",%.0f,%.4f\n", t->queries[step], t->seconds[step]);
        }
    }
    results_close(&b->s.r, f, name, ".csv");
}

static void ways_destroy(ways *v)
{
    for (int j = 0; j < v->problems * v->recipe_count; j++) {
        trail_destroy(&v->trails[j]);
    }
    free(v->trails);
    free(v->chamfer);
}

/* Geometric mean over the problems of recipe m's image loss (values NULL) or of values (problems * recipe_count, n). */
static double ways_mean(const ways *v, int m, int step, const double *values, int n)
{
    double sum = 0;
    for (int i = 0; i < v->problems; i++) {
        int j = i * v->recipe_count + m;
        double value = values ? values[j * n + step] : v->trails[j].image[step];
        sum += log(value > 1e-12 ? value : 1e-12);
    }
    return exp(sum / v->problems);
}

static double ways_queries(const ways *v, int m, int step)
{
    double sum = 0;
    for (int i = 0; i < v->problems; i++) {
        sum += v->trails[i * v->recipe_count + m].queries[step] / v->problems;
    }
    return sum;
}

static double ways_seconds(const ways *v, int m, int step)
{
    double sum = 0;
    for (int i = 0; i < v->problems; i++) {
        sum += v->trails[i * v->recipe_count + m].seconds[step] / v->problems;
    }
    return sum;
}

/* ---- acceleration, loss and distance ----------------------------------------------------------------------------- */

static double pearson(int n, const double *x, const double *y)
{
    double mx = 0, my = 0, xx = 0, yy = 0, xy = 0;
    for (int i = 0; i < n; i++) {
        mx += x[i] / n;
        my += y[i] / n;
    }
    for (int i = 0; i < n; i++) {
        xx += (x[i] - mx) * (x[i] - mx);
        yy += (y[i] - my) * (y[i] - my);
        xy += (x[i] - mx) * (y[i] - my);
    }
    return xx > 0 && yy > 0 ? xy / sqrt(xx * yy) : 0;
}

/* Ranks, equal values sharing the mean of theirs. */
static void ranks(int n, const double *x, double *rank)
{
    for (int i = 0; i < n; i++) {
        rank[i] = 0;
        for (int j = 0; j < n; j++) {
            rank[i] += x[j] < x[i] ? 1.0 : x[j] > x[i] || i == j ? 0.0 : 0.5;
        }
    }
}

static double spearman(int n, const double *x, const double *y)
{
    double *rx = (double *)take((size_t)(2 * n), sizeof *rx);
    ranks(n, x, rx);
    ranks(n, y, rx + n);
    double result = pearson(n, rx, rx + n);
    free(rx);
    return result;
}

/* Loss and distance of one recipe's fits, at the checks where both are known. */
static void correlation(const bench *b, const ways *v, int m, FILE *f)
{
    char path[PATH_SIZE];
    int most = v->problems * v->check_count;
    int n = 0;
    double *x = (double *)take((size_t)(2 * most + v->problems), sizeof *x);
    double *y = x + most, *each = y + most;
    plot figure = plot_begin("Loss on the picture and distance of the shapes", "the same fits' steps", 1);
    plot_panel *panel = plot_add_panel(&figure, "", "weighted loss on depth and silhouette", "Chamfer distance x 1000",
                                       PLOT_LOG_X | PLOT_LOG_Y);
    figure.panel_width = 420;
    figure.panel_height = 300;
    for (int i = 0; i < v->problems; i++) {
        int j = i * v->recipe_count + m, first = n;
        plot_series *s = plot_series_of(panel, shape_family_name(i % FAMILIES));
        s->no_line = 1;
        for (int k = 0; k < v->check_count; k++) {
            double loss = v->checks[k] < b->s.iterations ? v->trails[j].image[v->checks[k]] : 0;
            double distance = v->chamfer[j * v->check_count + k];
            if (!(loss > 0) || !(distance < 1e30)) { continue; }
            plot_add(s, loss, distance);
            x[n] = log10(loss);
            y[n++] = log10(distance);
        }
        each[i] = spearman(n - first, x + first, y + first);
    }
    fprintf(f,
            "\nLoss on the picture and Chamfer distance over the fits of *%s*, %d points: Pearson's correlation of the"
            " logarithms\n%.3f, Spearman's of the ranks %.3f; along each fit by itself Spearman's is %.3f in the"
            " median.\n\n![loss and distance](completion_correlation.svg)\n",
            v->recipes[m].name, n, pearson(n, x, y), spearman(n, x, y), results_median((size_t)v->problems, each));
    plot_write(&figure, path_of(path, results_stem(&b->s.r, "completion_correlation"), ".svg"), results_machine());
    puts(path);
    free(x);
}

static void curves(const bench *b)
{
    static const char *const names[6] = {"parallel",      "+ dynamic", "+ aggressive", "+ coarse-to-fine",
                                         "ours, guarded", "ours, warm"};
    static const int rows[4] = {DIST_PAPER_PARALLEL, DIST_PAPER_DYNAMIC, DIST_PAPER_AGGRESSIVE,
                                DIST_PAPER_COARSE_TO_FINE};
    const char *name = "completion_curves";
    char path[PATH_SIZE];
    ways v;
    memset(&v, 0, sizeof v);
    v.size = 2 * b->s.size / 3;
    v.problems = b->s.r.quick ? 1 : 2 * FAMILIES;
    v.recipe_count = 6;
    v.only = 4;
    for (int m = 0; m < v.recipe_count; m++) {
        recipe *r = &v.recipes[m];
        *r = recipe_make(b, names[m], 0, SILHOUETTE_WRONG);
        r->how.gradient = DIST_GRADIENT_PAPER;
        r->how.warm_start = m == 5;
        r->how.trace = m < 4 ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        r->how.paper_row = m < 4 ? rows[m] : 0;
    }
    for (int step = 0; step <= b->s.iterations; step += 5) {
        v.checks[v.check_count++] = step;
    }
    ways_run(b, &v, name);
    plot figure = plot_begin("Fits with each acceleration on and off", "dense depth and silhouette; geometric mean", 2);
    plot_panel *a = plot_add_panel(&figure, "by steps", "step", "weighted loss on the picture", PLOT_LOG_Y);
    plot_panel *c = plot_add_panel(&figure, "by queries", "queries", "weighted loss on the picture",
                                   PLOT_LOG_X | PLOT_LOG_Y);
    FILE *f = results_section(&b->s.r, name, "Loss curves with each acceleration on and off",
                              "build/results_completion");
    fprintf(f,
            "The paper's rows, each with all before it, and our tracer; all with the paper's gradient (K = 1), dense"
            " depth and\nsilhouette, %d held-out shapes, %d x %d pixels. Loss: depth and silhouette, weighted; "
            "geometric means. The paper shows\nsuch curves, and the loss against the Chamfer distance, in a figure "
            "without numbers, of a shape and a decoder of its own.\n\n"
            "| | loss at the start | after %d steps | after %d | Chamfer x 1000 at the end | queries, millions | "
            "processor seconds |\n|---|---|---|---|---|---|---|\n",
            v.problems, v.size, v.size, b->s.iterations / 4, b->s.iterations - 1);
    for (int m = 0; m < v.recipe_count; m++) {
        plot_series *s = plot_add_series(a, names[m]), *t = plot_add_series(c, names[m]);
        s->marker = t->marker = PLOT_NO_MARKER;
        for (int step = 0; step < b->s.iterations; step++) {
            plot_add(s, step, ways_mean(&v, m, step, NULL, 0));
            plot_add(t, ways_queries(&v, m, step + 1), ways_mean(&v, m, step, NULL, 0));
        }
        fprintf(f, "| %s | %.4f | %.4f | %.4f | %.3f | %.2f | %.2f |\n", names[m], ways_mean(&v, m, 0, NULL, 0),
                ways_mean(&v, m, b->s.iterations / 4, NULL, 0), ways_mean(&v, m, b->s.iterations - 1, NULL, 0),
                ways_mean(&v, m, v.check_count - 1, v.chamfer, v.check_count),
                ways_queries(&v, m, b->s.iterations) / 1e6, ways_seconds(&v, m, b->s.iterations));
    }
    fputs("\n![curves](completion_curves.svg)\n", f);
    plot_write(&figure, path_of(path, results_stem(&b->s.r, name), ".svg"), results_machine());
    puts(path);
    correlation(b, &v, 4, f);
    results_close(&b->s.r, f, name, ".md");
    ways_destroy(&v);
}

/* ---- gradients --------------------------------------------------------------------------------------------------- */

/* The first step, not a whole one, at which the distance falls below `goal`, the logarithm being straight between two
   checks; infinity where it does not. */
static double step_reached(const ways *v, int j, double goal)
{
    const double *chamfer = v->chamfer + j * v->check_count;
    if (chamfer[0] <= goal) { return 0; }
    for (int k = 1; k < v->check_count; k++) {
        if (!(chamfer[k] <= goal)) { continue; }
        double share = chamfer[k - 1] < 1e30 ? log(chamfer[k - 1] / goal) / log(chamfer[k - 1] / chamfer[k]) : 1;
        return v->checks[k - 1] + share * (v->checks[k] - v->checks[k - 1]);
    }
    return (double)INFINITY;
}

static double value_at(const double *values, double step)
{
    int i = (int)step;
    return values[i] + (step > i ? (step - i) * (values[i + 1] - values[i]) : 0);
}

static void gradients(const bench *b)
{
    static const struct {
        const char *name;
        int gradient, samples;
    } modes[5] = {{"implicit", DIST_GRADIENT_IMPLICIT, 1},
                  {"normal", DIST_GRADIENT_NORMAL, 1},
                  {"paper, K = 1", DIST_GRADIENT_PAPER, 1},
                  {"paper, K = 3", DIST_GRADIENT_PAPER, 3},
                  {"paper, K = 5", DIST_GRADIENT_PAPER, 5}};
    static const double goals[3] = {2, 1, 0.5};
    const char *name = "completion_gradients";
    char path[PATH_SIZE];
    ways v;
    memset(&v, 0, sizeof v);
    v.size = 2 * b->s.size / 3;
    v.problems = b->s.r.quick ? 1 : 2 * FAMILIES;
    v.recipe_count = 5;
    for (int m = 0; m < v.recipe_count; m++) {
        v.recipes[m] = recipe_make(b, modes[m].name, 0, SILHOUETTE_WRONG);
        v.recipes[m].how.gradient = modes[m].gradient;
        v.recipes[m].how.samples = modes[m].samples;
        v.recipes[m].how.warm_start = 0;
    }
    for (int step = 0; step <= b->s.iterations; step += step < 40 ? 4 : 10) {
        v.checks[v.check_count++] = step;
    }
    ways_run(b, &v, name);
    plot figure = plot_begin("Gradients", "dense depth and silhouette; geometric mean over the shapes", 2);
    plot_panel *a = plot_add_panel(&figure, "by steps", "step", "Chamfer distance x 1000", PLOT_LOG_Y);
    plot_panel *c = plot_add_panel(&figure, "by processor time", "seconds", "Chamfer distance x 1000", PLOT_LOG_Y);
    FILE *f = results_section(&b->s.r, name, "Gradients: steps and seconds to a given distance",
                              "build/results_completion");
    fprintf(f,
            "%d held-out shapes, dense depth and silhouette, %d x %d pixels, our tracer without warm start. For each "
            "Chamfer distance\nx 1000: fits that reach it within %d steps; of all fits the median step, queries and "
            "processor seconds at which they do\n(none: half of them or more do not). At the end: geometric mean. "
            "The paper has K, without a number for it.\n\n"
            "| |",
            v.problems, v.size, v.size, b->s.iterations);
    for (int g = 0; g < 3; g++) {
        fprintf(f, " %.1f: reached | steps | queries, millions | seconds |", goals[g]);
    }
    fputs(" at the end |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n", f);
    double *t = (double *)take((size_t)(3 * v.problems), sizeof *t);
    double *q = t + v.problems, *seconds = q + v.problems;
    for (int m = 0; m < v.recipe_count; m++) {
        plot_series *s = plot_add_series(a, modes[m].name), *u = plot_add_series(c, modes[m].name);
        for (int k = 0; k < v.check_count; k++) {
            double mean = ways_mean(&v, m, k, v.chamfer, v.check_count);
            plot_add(s, v.checks[k], mean);
            plot_add(u, ways_seconds(&v, m, v.checks[k]), mean);
        }
        fprintf(f, "| %s |", modes[m].name);
        for (int g = 0; g < 3; g++) {
            int reached = 0;
            for (int i = 0; i < v.problems; i++) {
                int j = i * v.recipe_count + m;
                t[i] = step_reached(&v, j, goals[g]);
                int is = t[i] < 1e30;
                reached += is;
                q[i] = is ? value_at(v.trails[j].queries, t[i]) / 1e6 : t[i];
                seconds[i] = is ? value_at(v.trails[j].seconds, t[i]) : t[i];
            }
            fprintf(f, " %d of %d |", reached, v.problems);
            print_value(f, results_median((size_t)v.problems, t), 0);
            print_value(f, results_median((size_t)v.problems, q), 0);
            print_value(f, results_median((size_t)v.problems, seconds), 0);
        }
        print_value(f, ways_mean(&v, m, v.check_count - 1, v.chamfer, v.check_count), 0);
        fputs("\n", f);
    }
    free(t);
    fputs("\n![gradients](completion_gradients.svg)\n", f);
    results_close(&b->s.r, f, name, ".md");
    plot_write(&figure, path_of(path, results_stem(&b->s.r, name), ".svg"), results_machine());
    puts(path);
    ways_destroy(&v);
}

int main(int argc, char **argv)
{
    settings s;
    memset(&s, 0, sizeof s);
    s.r.out = "bench/results";
    s.first = SHAPE_HELD_OUT;
    s.iterations = 100;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--only")) {
            s.r.only = option_text(&o);
        } else if (option_is(&o, "--out")) {
            s.r.out = option_text(&o);
        } else if (option_is(&o, "--quick")) {
            s.r.quick = option_flag(&o);
        } else if (option_is(&o, "--shapes")) {
            s.shapes = option_int(&o, 1, 100000);
        } else if (option_is(&o, "--first")) {
            s.first = option_int(&o, 0, 100000000);
        } else if (option_is(&o, "--size")) {
            s.size = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--threads")) {
            s.threads = option_int(&o, 1, 1024);
        } else {
            option_unknown(&o);
        }
    }
    results_check(&s.r);
    if (!s.shapes) { s.shapes = s.r.quick ? 2 : 20; }
    if (!s.size) { s.size = s.r.quick ? 40 : 96; }
    if (s.r.quick) { s.iterations = 20; }
    bench b = bench_create(&s);
    int found = 0;
    if (results_wanted(&s.r, "completion")) { completion(&b), found = 1; }
    if (results_wanted(&s.r, "completion_silhouette")) { silhouettes(&b), found = 1; }
    if (results_wanted(&s.r, "completion_curves")) { curves(&b), found = 1; }
    if (results_wanted(&s.r, "completion_gradients")) { gradients(&b), found = 1; }
    check_found("--only", s.r.only, found);
    bench_destroy(&b);
    return 0;
}
