/* SPDX-License-Identifier: MIT-0
   bench_work_precision.c - error against cost: what each tracer's pictures are off by, and what they took, as epsilon,
   alpha and the budget of steps change. CSV on stdout; on stderr, in the end, where dist.h does badly.

   The reference is found by small steps and bisection in double. Of a network the steps and the first bisection are
   dist_field_eval's; the hit is then moved to the root of the network in double (exact.h), its normal and the smallest
   |f| beside the outline are in double. The steps are those that the true slope proves (2.6 for networks), but at
   least 1e-5 (networks: 5e-5).

   What of a large picture is measured: a window of it (256 x 256 pixels; slower decoders: 128 x 128, the slowest: 64 x
   64; --window: of another size), by the same camera, with the parameters that its size asks for, so that the whole
   grid of rows is made in one to two hours; column `window`. Of those with at least half the whole picture's share of
   hits it is the one whose shares of hits and of rays that meet the bounding sphere are nearest the whole picture's, and
   every pixel of it is compared. `queries_per_pixel`
   and `operations_per_pixel` are of the window's pixels. What the whole picture takes is in a row of its own, of
   guarded's default, without errors: parameter `whole`.

   Wrong pixels are counted against the surface itself, not against its epsilon:
       hole        the ray goes in by more than CLEAR, and mask is 0
       false hit   mask is 1, and the ray keeps farther than CLEAR from the surface; or misses the bounding sphere
   Errors are those of the distance at the pixels that are hit in both; a bound is violated where the error is larger
   than the plane `error` and CLEAR. `touched`: such pixels whose ray came within epsilon of the surface before, without
   crossing it, which may count as a hit by the definition of epsilon; they are among the violations. The silhouette is
   compared at the misses, and `near` at those whose ray comes within NEAR of the surface. operations: multiply-adds
   that were done, without those of dead units; 0 without a network.
   Queries, operations and seconds are those of a picture of distance and mask alone; seconds: median of `runs`. With
   the silhouette they are queries_with_silhouette and, of one run, seconds_with_silhouette.

   Methods that differ in their gradient alone (guarded_K*, guarded_uncapped, paper_K*) have the picture of guarded or of
   paper_coarse_to_fine_50, measured once: only their gradient's columns are their own.

   Gradients are those of sum of |n . v| depth over the pixels that should be hit, for the code and for the camera
   (rotation and translation), against the exact ones: the implicit function theorem at the reference's points, all in
   double, a network's derivatives too. norm_error: |g - exact| / |exact|. gradient_queries: those of the
   picture with a tape and the points of its adjoint; gradient_seconds: of both, one run. Warm pictures start from that
   of a code one part in 2000 away. guarded_dense leaves no dead unit out where only values are asked for. guarded_f16
   and _bf16 take field.coarse_fn for everything (dist_net_set_half): the bound then counts in what f was seen to be off.
   Where the processor has none of it the row says "not available".

   Every row is made; --seconds only bounds how often one is timed: 7 times, but no more than take so long (`runs`).
   "done" on stderr tells what a size took. --have takes the rows of a size that an earlier run finished from its csv.

   --svg draws each case and size. Lines join the epsilons of one method, or its alphas or budgets of steps; the larger
   markers are the defaults. A marker is open where the picture failed: more than 1 in 1000 pixels that should be hit is
   wrong, or as many hits of our own (and not a single one) are farther off than their bound. STEM_sizes.svg holds the
   epsilons of guarded and of the paper's coarse-to-fine row at each size, scene by scene. STEM_losses.svg holds our
   default against the best of all of the paper's rows, by each measure for itself: points above the line are where
   dist.h loses. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "exact.h"
#include "plot.h"
#ifdef _OPENMP
#include <omp.h>
#endif

static const char usage[] =
    "bench_work_precision [options]\n"
    "  --case NAME        only this one\n"
    "  --list             prints the cases' names, and ends\n"
    "  --size N           only pictures of N x N (default 64, 128, 256, 512 and 1024)\n"
    "  --largest N        pictures of 64 x 64 up to N x N (default 1024)\n"
    "  --window N         of larger pictures N x N pixels (default 256, 128 or 64: slow decoders have less)\n"
    "  --seconds S        times a row only as often as takes S seconds (default: 7 times, however long)\n"
    "  --have FILE.csv    rows of an earlier run; sizes that it finished are not made again\n"
    "  --svg STEM         also plots, STEM_CASE_N.svg\n"
    "  --workers N        threads of a picture (default 1: then seconds vary least)\n"
    "  --at-once N        cases at a time, each on a core of its own, cheap ones beside slow ones; the rows of one\n"
    "                     case stay in order (default 1)\n"
    "  --quick            64 pixels, few cases and few values\n";

enum { SPHERE, TORUS, BOX, RODS, BUMPS };
#define CLEAR 2e-6
#define NEAR 0.02

typedef struct scene {
    const char *name, *net; /* net NULL: analytic */
    int kind;
    double n[3];            /* sphere: radius; torus: radii; box: half extents; rods: radius; bumps: radius, height,
                               frequency */
    double clamp, slope;    /* true slope at most; the field says 1 */
    double elevation;       /* of the eye, degrees */
    int code, empty, quick; /* empty: the picture shows the upper half, the shape is in the lower */
    int window;             /* pixels along a side of what is measured of larger pictures */
} scene;

static const scene scenes[] = {
    {"sphere", NULL, SPHERE, {0.8, 0, 0}, 0, 1, 25, 0, 0, 1, 256},
    {"plate_1e-3", NULL, BOX, {0.6, 0.5, 5e-4}, 0, 1, 25, 0, 0, 1, 256},
    {"rods_1e-3", NULL, RODS, {1e-3, 0, 0}, 0, 1, 25, 0, 0, 1, 256},
    {"torus_grazing", NULL, TORUS, {0.66, 0.22, 0}, 0, 1, 19.3, 0, 0, 1, 256},
    {"bumps_slope_2", NULL, BUMPS, {0.7, 0.05, 20}, 0, 2, 25, 0, 0, 1, 256},
    {"box_clamped", NULL, BOX, {0.4, 0.5, 0.3}, 0.1, 1, 25, 0, 0, 1, 256},
    {"empty", NULL, SPHERE, {0.15, 0, 0}, 0, 1, 25, 0, 1, 1, 256},
    {"embedded_5", "embedded", 0, {0, 0, 0}, 0, 2.6, 25, 5, 0, 1, 256},
    {"fox", "fox", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 1, 256},
    {"rings", "rings", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 256},
    {"bunny_relu", "bunny_relu", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 256},
    {"two_spheres_sine", "two_spheres_sine", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 128},
    {"spot", "bob_spot", 0, {0, 0, 0}, 0, 2.6, 25, 1, 0, 0, 128},
    {"round_cross_10", "round_cross", 0, {0, 0, 0}, 0, 2.6, 25, 10, 0, 0, 128},
    {"mug", "mug_camera_bottle", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 64},
    {"primitives_13", "primitives", 0, {0, 0, 0}, 0, 2.6, 25, 13, 0, 0, 256},
    {"spot_geometry", "spot_geometry", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 128},
    {"chairs_3", "chairs", 0, {0, 0, 0}, 0, 2.6, 25, 3, 0, 0, 64},
    {"spot_512", "deepsdf_512", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 64},
    {"spot_512_he", "deepsdf_512_he", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 64},
};

typedef struct method {
    const char *name;
    int trace, row, steps, no_cones, no_prediction, certified, by_alpha, by_steps;
    int gradient, samples, warm, dense, uncapped; /* dense: dead units are not looked for */
    int half;                                     /* DIST_HALF_* */
} method;

/* The last are the dearest. */
enum { GUARDED = 0, COARSE_TO_FINE = 2 }; /* whose pictures others share */
static const method methods[] = {
    {"guarded", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0},
    {"certified", DIST_TRACE_GUARDED, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0},
    {"paper_coarse_to_fine_50", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 50, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"paper_aggressive_50", DIST_TRACE_PAPER, DIST_PAPER_AGGRESSIVE, 50, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0},
    {"paper_dynamic_50", DIST_TRACE_PAPER, DIST_PAPER_DYNAMIC, 50, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"guarded_no_prediction", DIST_TRACE_GUARDED, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"guarded_no_cones", DIST_TRACE_GUARDED, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"guarded_dense", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0},
    {"guarded_warm", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0},
    {"guarded_f16", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, DIST_HALF_F16},
    {"guarded_bf16", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, DIST_HALF_BF16},
    {"guarded_uncapped", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0},
    {"guarded_K1", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, DIST_GRADIENT_PAPER, 1, 0, 0, 0, 0},
    {"guarded_K3", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, DIST_GRADIENT_PAPER, 3, 0, 0, 0, 0},
    {"guarded_K5", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 0, 0, DIST_GRADIENT_PAPER, 5, 0, 0, 0, 0},
    {"paper_dynamic_100", DIST_TRACE_PAPER, DIST_PAPER_DYNAMIC, 100, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"paper_aggressive_100", DIST_TRACE_PAPER, DIST_PAPER_AGGRESSIVE, 100, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"paper_coarse_to_fine_100", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 100, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"paper_K3", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 50, 0, 0, 0, 0, 0, DIST_GRADIENT_PAPER, 3, 0, 0, 0, 0},
    {"paper_K5", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 50, 0, 0, 0, 0, 0, DIST_GRADIENT_PAPER, 5, 0, 0, 0, 0},
    {"paper_parallel_50", DIST_TRACE_PAPER, DIST_PAPER_PARALLEL, 50, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {"paper_parallel_100", DIST_TRACE_PAPER, DIST_PAPER_PARALLEL, 100, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
};

enum { SCENES = sizeof scenes / sizeof scenes[0], METHODS = sizeof methods / sizeof methods[0] };
enum { MOST_ROWS = 2048 }; /* of a scene */
#define EMPTY ",,,,,,,,,,,,,,,,,,,,,,,,,,,,," /* the rest of a row */

/* ---- fields ------------------------------------------------------------------------------------------------------ */

static double length_of(double x, double y, double z)
{
    return sqrt(x * x + y * y + z * z);
}

/* A box turned out of the axes. */
static double box_value(const double half[3], const double p[3])
{
    double q[3] = {0.8 * p[0] + 0.6 * p[1], 0.8 * p[1] - 0.6 * p[0], p[2]};
    double r[3] = {q[0], 0.96 * q[1] + 0.28 * q[2], 0.96 * q[2] - 0.28 * q[1]};
    double most = -1e30;
    for (int i = 0; i < 3; i++) {
        r[i] = fabs(r[i]) - half[i];
        most = fmax(most, r[i]);
    }
    return length_of(fmax(r[0], 0), fmax(r[1], 0), fmax(r[2], 0)) + fmin(most, 0);
}

/* Twelve capsules of different directions. */
static double rods_value(double radius, const double p[3])
{
    double least = 1e30;
    for (int k = 0; k < 12; k++) {
        double z = (k + 0.5) / 6 - 1;
        double s = sqrt(1 - z * z);
        double d[3] = {s * cos(2.4 * k), s * sin(2.4 * k), z};
        double q[3] = {p[0] - 0.5 * d[1], p[1] - 0.5 * d[2], p[2] + 0.5 * d[0]};
        double t = fmax(-0.45, fmin(0.45, q[0] * d[0] + q[1] * d[1] + q[2] * d[2]));
        least = fmin(least, length_of(q[0] - t * d[0], q[1] - t * d[1], q[2] - t * d[2]));
    }
    return least - radius;
}

static double value_of(const scene *s, const double p[3])
{
    const double *n = s->n;
    double f = 0;
    switch (s->kind) {
    case SPHERE: f = length_of(p[0], p[1] + (s->empty ? 0.8 : 0), p[2]) - n[0]; break;
    case TORUS: f = length_of(length_of(p[0], p[2], 0) - n[0], p[1], 0) - n[1]; break;
    case BOX: f = box_value(n, p); break;
    case RODS: f = rods_value(n[0], p); break;
    case BUMPS: f = length_of(p[0], p[1], p[2]) - n[0] + n[1] * sin(n[2] * p[0]) * cos(n[2] * p[1]); break;
    }
    return s->clamp > 0 ? fmax(-s->clamp, fmin(s->clamp, f)) : f;
}

static void gradient_of(const scene *s, const double p[3], double gradient[3])
{
    const double h = 1e-6;
    for (int a = 0; a < 3; a++) {
        double q[3] = {p[0], p[1], p[2]};
        q[a] = p[a] + h;
        gradient[a] = value_of(s, q);
        q[a] = p[a] - h;
        gradient[a] = (gradient[a] - value_of(s, q)) / (2 * h);
    }
}

static void analytic_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const scene *s = (const scene *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        double p[3] = {(double)points[3 * i], (double)points[3 * i + 1], (double)points[3 * i + 2]};
        double g[3];
        sdf[i] = (float)value_of(s, p);
        if (!gradient) { continue; }
        gradient_of(s, p, g);
        for (size_t a = 0; a < 3; a++) { gradient[3 * i + a] = (float)g[a]; }
    }
}

/* All analytic fields say that their slope is 1, in the bounding sphere of a network. `user` is `copy`. */
static dist_field analytic_field(const scene *s, scene *copy)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    *copy = *s;
    field.user = copy;
    field.eval_fn = analytic_eval;
    field.radius = 1;
    field.lipschitz = 1;
    field.clamp = (float)s->clamp;
    return field;
}

static dist_camera camera_of(const scene *s, const dist_field *field, int size)
{
    const float azimuth = 35.0f * PI / 180.0f;
    const float up[3] = {0, 1, 0};
    float elevation = (float)s->elevation * PI / 180.0f;
    float r = 2.2f * field->radius;
    float eye[3];
    eye[0] = field->center[0] + r * cosf(elevation) * sinf(azimuth);
    eye[1] = field->center[1] + r * sinf(elevation);
    eye[2] = field->center[2] + r * cosf(elevation) * cosf(azimuth);
    dist_camera camera = dist_camera_look_at(size, size, 1.0f, eye, field->center, up);
    camera.fx = camera.fy = 385.0f * (float)size / 512.0f;
    if (s->empty) { camera.cy = (float)size; }
    return camera;
}

/* ---- reference --------------------------------------------------------------------------------------------------- */

/* barely: goes in by no more than CLEAR */
enum { REF_OUTSIDE = 0, REF_MISS, REF_HIT, REF_BARELY, REF_INSIDE };

typedef struct reference {
    size_t n, in_sphere, hits;
    double origin[3];
    double *distance, *smallest; /* smallest f, of rays that miss */
    double *dip;                 /* lowest f before the crossing from which it rose again */
    double *normal;              /* (n, 3): grad f */
    unsigned char *status;
} reference;

typedef struct ray {
    double d[3], t, previous, exit, f, low, high; /* low..high holds the smallest f */
    size_t pixel;
} ray;

typedef struct prober {
    dist_context *ctx;
    const scene *s;
    const dist_field *field;
    const double *origin;
    exact *e; /* of a network */
    float *points, *sdf;
    double *at, *gradient; /* (n, 3) */
} prober;

/* f of each ray at its t; of a network in single precision. */
static void probe(const prober *p, size_t n, const ray *rays, double *sdf)
{
    for (size_t i = 0; i < n; i++) {
        double at[3];
        for (int a = 0; a < 3; a++) {
            at[a] = p->origin[a] + rays[i].t * rays[i].d[a];
            p->points[3 * i + (size_t)a] = (float)at[a];
        }
        if (!p->s->net) { sdf[i] = value_of(p->s, at); }
    }
    if (!p->s->net || n == 0) { return; }
    dist_field_eval(p->ctx, p->field, n, p->points, p->sdf, NULL);
    check(p->ctx);
    for (size_t i = 0; i < n; i++) { sdf[i] = (double)p->sdf[i]; }
}

/* In double, a network's too, and grad f into p->gradient unless `slopes` is 0. */
static void probe_exactly(const prober *p, size_t n, const ray *rays, double *sdf, int slopes)
{
    for (size_t i = 0; i < n; i++) {
        for (size_t a = 0; a < 3; a++) { p->at[3 * i + a] = p->origin[a] + rays[i].t * rays[i].d[a]; }
        if (p->s->net) { continue; }
        sdf[i] = value_of(p->s, p->at + 3 * i);
        if (slopes) { gradient_of(p->s, p->at + 3 * i, p->gradient + 3 * i); }
    }
    if (p->s->net) { exact_eval(p->e, n, p->at, sdf, slopes ? p->gradient : NULL, NULL); }
}

/* The ray of pixel i, at its entry into the bounding sphere; 0: it does not meet it. */
static int ray_of(const dist_field *field, const dist_camera *camera, const disti_view *eye, int i, ray *r)
{
    double x = ((double)(i % camera->width) + eye->first - eye->cx) / eye->fx;
    double y = ((double)(i / camera->width) + eye->first - eye->cy) / eye->fy;
    double length = length_of(x, y, 1);
    double b = 0, c = 0;
    memset(r, 0, sizeof *r);
    for (int a = 0; a < 3; a++) {
        double from = eye->center[a] - (double)field->center[a];
        r->d[a] = (eye->rotation[a] * x + eye->rotation[3 + a] * y + eye->rotation[6 + a]) / length;
        b += from * r->d[a];
        c += from * from;
    }
    double root = b * b - c + (double)field->radius * (double)field->radius;
    if (root <= 0) { return 0; }
    r->t = r->previous = fmax(-b - sqrt(root), 0);
    r->exit = -b + sqrt(root);
    r->f = 1e30;
    r->pixel = (size_t)i;
    return 1;
}

static size_t rays_of(const dist_field *field, const dist_camera *camera, double origin[3], ray *rays)
{
    size_t count = 0;
    disti_view eye;
    disti_view_of(camera, &eye);
    for (int a = 0; a < 3; a++) { origin[a] = eye.center[a]; }
    for (int i = 0; i < camera->width * camera->height; i++) {
        count += (size_t)ray_of(field, camera, &eye, i, rays + count);
    }
    return count;
}

/* Halves the bracket previous..t of each hit. */
static void bisect(const prober *p, size_t n, ray *rays, double *sdf)
{
    for (int round = 0; round < (p->s->net ? 30 : 50); round++) {
        for (size_t i = 0; i < n; i++) {
            rays[i].exit = rays[i].t; /* the inner end; its first meaning is not needed any more */
            rays[i].t = 0.5 * (rays[i].previous + rays[i].t);
        }
        probe(p, n, rays, sdf);
        for (size_t i = 0; i < n; i++) {
            if (sdf[i] >= 0) {
                rays[i].previous = rays[i].t;
                rays[i].t = rays[i].exit;
            }
        }
    }
}

/* A network's hits are at roots of single precision, with noise of 1e-6 or so: two steps of Newton in double, short
   ones; the point of least |f| is kept. Leaves f and grad f there. */
static void polish(const prober *p, size_t n, ray *rays, double *sdf)
{
    for (size_t i = 0; i < n; i++) { rays[i].t = 0.5 * (rays[i].previous + rays[i].t); }
    probe_exactly(p, n, rays, sdf, 1);
    if (!p->s->net) { return; }
    double *before = (double *)take(n, sizeof *before);
    for (int round = 0; round < 2; round++) {
        for (size_t i = 0; i < n; i++) {
            const double *g = p->gradient + 3 * i;
            double slope = g[0] * rays[i].d[0] + g[1] * rays[i].d[1] + g[2] * rays[i].d[2];
            before[i] = sdf[i];
            rays[i].previous = rays[i].t;
            if (slope < 0) { rays[i].t += fmax(-1e-4, fmin(1e-4, -sdf[i] / slope)); }
        }
        probe_exactly(p, n, rays, sdf, 1);
        for (size_t i = 0; i < n; i++) {
            if (fabs(sdf[i]) > fabs(before[i])) { rays[i].t = rays[i].previous; } /* a kink lies between */
        }
    }
    free(before);
}

/* Thirds the interval low..high of each miss that holds its smallest f. */
static void smallest(const prober *p, size_t n, ray *rays, double *sdf, double *other, double *least)
{
    for (int round = 0; round < (p->s->net ? 16 : 40); round++) {
        for (size_t i = 0; i < n; i++) { rays[i].t = (2 * rays[i].low + rays[i].high) / 3; }
        probe(p, n, rays, sdf);
        for (size_t i = 0; i < n; i++) { rays[i].t = (rays[i].low + 2 * rays[i].high) / 3; }
        probe(p, n, rays, other);
        for (size_t i = 0; i < n; i++) {
            double third = (rays[i].high - rays[i].low) / 3;
            double *best = least + rays[i].pixel;
            *best = fmin(*best, fmin(sdf[i], other[i]));
            if (sdf[i] < other[i]) {
                rays[i].high -= third;
            } else {
                rays[i].low += third;
            }
        }
    }
    if (!p->s->net) { return; }
    size_t count = 0;
    for (size_t i = 0; i < n; i++) {
        rays[i].t = 0.5 * (rays[i].low + rays[i].high);
        if (least[rays[i].pixel] <= NEAR) { rays[count++] = rays[i]; }
    }
    probe_exactly(p, count, rays, sdf, 0);
    for (size_t i = 0; i < count; i++) { /* unless the smallest was elsewhere */
        double *best = least + rays[i].pixel;
        if (fabs(sdf[i] - *best) < 1e-5) { *best = sdf[i]; }
    }
}

/* Marches every ray to its first f < 0; returns how many cross, and sorts hits and misses into their arrays. */
static size_t march(const prober *p, reference *ref, size_t active, ray *rays, ray *hits, ray *misses, double *sdf)
{
    double shortest = p->s->net ? 5e-5 : 1e-5;
    size_t hit_count = 0;
    size_t miss_count = 0;
    for (int round = 0; active; round++) {
        size_t kept = 0;
        probe(p, active, rays, sdf);
        for (size_t i = 0; i < active; i++) {
            ray r = rays[i];
            double *least = ref->smallest + r.pixel;
            double *dip = ref->dip + r.pixel;
            int barely = sdf[i] < 0 && sdf[i] >= -CLEAR;
            if (barely && round && r.t + shortest < r.exit) { /* on, to see whether it goes in */
                r.f = sdf[i];
                r.t += shortest;
                rays[kept++] = r;
                continue;
            }
            if (sdf[i] < 0 || r.f < 0) {
                ref->status[r.pixel] = round == 0 ? REF_INSIDE : sdf[i] < -CLEAR ? REF_HIT : REF_BARELY;
                if (sdf[i] >= 0) { r.t -= shortest; }
                if (round) { hits[hit_count++] = r; }
                continue;
            }
            double step = fmax(sdf[i] / p->s->slope, shortest);
            if (sdf[i] > r.f && r.f < *dip) { *dip = r.f; }
            if (sdf[i] < *least) {
                *least = sdf[i];
                r.low = r.previous;
                r.high = fmin(r.t + step, r.exit);
            }
            r.f = sdf[i];
            r.previous = r.t;
            r.t += step;
            if (r.t < r.exit) {
                rays[kept++] = r;
            } else {
                misses[miss_count++] = r;
            }
        }
        active = kept;
    }
    for (size_t i = 0; i < miss_count; i++) { rays[i] = misses[i]; }
    return hit_count;
}

static reference reference_create(dist_context *ctx, const scene *s, const dist_field *field, exact *e,
                                  const dist_camera *camera)
{
    reference ref;
    prober p;
    ref.n = (size_t)camera->width * (size_t)camera->height;
    ref.distance = (double *)take(ref.n, sizeof(double));
    ref.smallest = (double *)take(ref.n, sizeof(double));
    ref.dip = (double *)take(ref.n, sizeof(double));
    ref.normal = (double *)take(3 * ref.n, sizeof(double));
    ref.status = (unsigned char *)take(ref.n, 1);
    ray *rays = (ray *)take(ref.n, sizeof *rays);
    ray *hits = (ray *)take(ref.n, sizeof *hits);
    ray *misses = (ray *)take(ref.n, sizeof *misses);
    double *sdf = (double *)take(ref.n, sizeof *sdf);
    double *other = (double *)take(ref.n, sizeof *other);
    p.ctx = ctx;
    p.s = s;
    p.field = field;
    p.origin = ref.origin;
    p.points = take_floats(3 * ref.n);
    p.sdf = take_floats(ref.n);
    p.e = e;
    p.at = (double *)take(3 * ref.n, sizeof(double));
    p.gradient = (double *)take(3 * ref.n, sizeof(double));
    ref.in_sphere = rays_of(field, camera, ref.origin, rays);
    for (size_t i = 0; i < ref.n; i++) { ref.smallest[i] = ref.dip[i] = 1e30; }
    for (size_t i = 0; i < ref.in_sphere; i++) { ref.status[rays[i].pixel] = REF_MISS; }
    size_t hit_count = march(&p, &ref, ref.in_sphere, rays, hits, misses, sdf);
    size_t inside = 0;
    ref.hits = 0;
    for (size_t i = 0; i < ref.n; i++) {
        inside += ref.status[i] == REF_INSIDE;
        ref.hits += ref.status[i] == REF_HIT;
    }
    smallest(&p, ref.in_sphere - hit_count - inside, rays, sdf, other, ref.smallest);
    bisect(&p, hit_count, hits, sdf);
    polish(&p, hit_count, hits, sdf);
    for (size_t i = 0; i < hit_count; i++) {
        ref.distance[hits[i].pixel] = hits[i].t;
        memcpy(ref.normal + 3 * hits[i].pixel, p.gradient + 3 * i, 3 * sizeof(double));
    }
    free(rays);
    free(hits);
    free(misses);
    free(sdf);
    free(other);
    free(p.points);
    free(p.sdf);
    free(p.at);
    free(p.gradient);
    return ref;
}

static void reference_destroy(reference *ref)
{
    free(ref->distance);
    free(ref->smallest);
    free(ref->dip);
    free(ref->normal);
    free(ref->status);
}

/* ---- one picture ------------------------------------------------------------------------------------------------- */

typedef struct row {
    const scene *s;
    const method *m;
    const char *parameter;
    double value;
    int size, window, runs; /* window: pixels along a side that were measured */
    double queries, operations, seconds, fastest, slowest, silhouette_queries, silhouette_seconds;
    double mean, p99, largest, normal, silhouette, near, violations, touched;
    double beyond; /* the violations' count */
    double gradient_queries, gradient_seconds;
    double code_cosine, code_error, camera_cosine, camera_error; /* errors < 0: there is none */
    size_t compared, hits, holes, false_hits, unresolved, true_hits;
} row;

/* A little more than acos of the dot product can tell apart near 0. */
static double degrees_between(const float *a, const double *y)
{
    double x[3] = {(double)a[0], (double)a[1], (double)a[2]};
    double cross = length_of(x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]);
    return atan2(cross, x[0] * y[0] + x[1] * y[1] + x[2] * y[2]) * 180 / 3.14159265358979323846;
}

static void compare(const reference *ref, const dist_images *out, double epsilon, row *r)
{
    double *errors = (double *)take(ref->n, sizeof *errors);
    double *angles = (double *)take(ref->n, sizeof *angles);
    size_t n = 0;
    size_t misses = 0;
    size_t near_misses = 0;
    r->true_hits = ref->hits;
    for (size_t i = 0; i < ref->n; i++) {
        int hit = out->mask[i] != 0;
        int status = ref->status[i];
        if (status == REF_INSIDE) { continue; }
        r->compared++;
        r->hits += (size_t)hit;
        r->unresolved += out->status[i] == DIST_RAY_UNRESOLVED;
        r->holes += status == REF_HIT && !hit;
        r->false_hits += hit && (status == REF_OUTSIDE || (status == REF_MISS && ref->smallest[i] > CLEAR));
        if (status == REF_MISS && !hit) {
            double off = fabs((double)out->silhouette[i] + epsilon - ref->smallest[i]);
            r->silhouette += off;
            misses++;
            if (ref->smallest[i] > NEAR) { continue; }
            r->near += off;
            near_misses++;
        }
        if (status != REF_HIT || !hit) { continue; }
        double error = fabs((double)out->distance[i] - ref->distance[i]);
        int violated = error > (double)out->error[i] + CLEAR;
        r->violations += violated;
        r->touched += violated && ref->dip[i] < epsilon;
        r->mean += error;
        angles[n] = degrees_between(out->normal + 3 * i, ref->normal + 3 * i);
        errors[n++] = error;
    }
    r->mean /= n ? (double)n : 1;
    r->beyond = r->violations;
    r->violations *= n ? 1000 / (double)n : 0;
    r->touched *= n ? 1000 / (double)n : 0;
    r->silhouette /= misses ? (double)misses : 1;
    r->near /= near_misses ? (double)near_misses : 1;
    r->p99 = quantile(n, errors, 0.99);
    r->largest = n ? errors[n - 1] : 0;
    r->normal = quantile(n, angles, 0.99);
    free(errors);
    free(angles);
}

/* What a case is made of; shape and code NULL without a network. */
typedef struct subject {
    dist_context *ctx;
    const scene *s;
    const dist_field *field;
    dist_shape *shape;
    const float *code;
    const dist_camera *camera;
    const reference *ref;
    exact *e; /* NULL without a network */
    size_t code_size;
    double *exact;  /* gradient for rotation, translation (6) and code */
    float *weights; /* (pixels): d_depth of the loss */
} subject;

/* dL/d(camera, code) by the implicit function theorem at the reference's hits, with weights |n . v|: a point of the ray
   is p = R^T (t d - T), its depth t d_z / |d|, so that with g = grad f and g . v t' = -g . (p' at fixed t)
       for T:  p' = -R^T e_k;    for R' = exp([w]x) R:  p' = -R^T (e_k x R p);    for z:  g . p' = df/dz. */
static void exact_gradient(subject *j)
{
    const dist_camera *c = j->camera;
    const reference *ref = j->ref;
    size_t count = 0;
    double *points = (double *)take(3 * ref->n, sizeof *points);
    double *d_sdf = (double *)take(ref->n, sizeof *d_sdf);
    double *values = (double *)take(ref->n, sizeof *values), *slopes = (double *)take(3 * ref->n, sizeof *slopes);
    disti_view eye;
    disti_view_of(c, &eye);
    for (size_t i = 0; i < ref->n; i++) {
        if (ref->status[i] != REF_HIT) { continue; }
        double x = ((double)(i % (size_t)c->width) + eye.first - eye.cx) / eye.fx;
        double y = ((double)(i / (size_t)c->width) + eye.first - eye.cy) / eye.fy;
        double length = length_of(x, y, 1);
        double along[3] = {x / length, y / length, 1 / length};
        double at[3], g[3], slope = 0, size = 0; /* in axes of the camera: R p, g */
        const double *normal = ref->normal + 3 * i;
        for (int a = 0; a < 3; a++) {
            at[a] = ref->distance[i] * along[a] - (double)c->translation[a];
            g[a] = 0;
            double p = ref->origin[a];
            for (int b = 0; b < 3; b++) {
                g[a] += eye.rotation[3 * a + b] * normal[b];
                p += eye.rotation[3 * b + a] * ref->distance[i] * along[b];
            }
            points[3 * count + (size_t)a] = p;
            slope += g[a] * along[a];
            size += g[a] * g[a];
        }
        if (slope == 0 || size == 0) { continue; }
        double weight = fabs(slope) / sqrt(size);
        double by = weight * along[2] / -slope; /* dL / d(g . p') */
        j->weights[i] = (float)weight;
        for (int k = 0; k < 3; k++) {
            int l = (k + 1) % 3;
            int m = (k + 2) % 3;
            j->exact[k] += by * (g[l] * at[m] - g[m] * at[l]); /* -g . (e_k x at) */
            j->exact[3 + k] += by * -g[k];
        }
        d_sdf[count++] = by;
    }
    if (j->code_size) {
        exact_forget(j->e);
        exact_eval(j->e, count, points, values, slopes, d_sdf);
        exact_code(j->e, j->exact + 6);
    }
    free(points);
    free(d_sdf);
    free(values);
    free(slopes);
}

/* Cosine and relative error of a gradient of n numbers. */
static void judge_gradient(size_t n, const float *g, const double *truth, double *cosine, double *error)
{
    double dot = 0, own = 0, other = 0, off = 0;
    for (size_t i = 0; i < n; i++) {
        dot += (double)g[i] * truth[i];
        own += (double)g[i] * (double)g[i];
        other += truth[i] * truth[i];
        off += ((double)g[i] - truth[i]) * ((double)g[i] - truth[i]);
    }
    *error = other > 0 ? sqrt(off / other) : -1;
    *cosine = own > 0 && other > 0 ? dot / sqrt(own * other) : 0;
}

static void gradient(const subject *j, const dist_render_desc *how, row *r)
{
    dist_images out, d_out;
    dist_gradients grads;
    dist_stats stats;
    float camera[6] = {0, 0, 0, 0, 0, 0};
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    memset(&stats, 0, sizeof stats);
    dist_render_desc cold = *how;
    cold.warm_start = 0;
    dist_tape *tape = dist_tape_create(j->ctx, j->camera, &cold);
    out.depth = take_floats(j->ref->n);
    out.stats = d_out.stats = &stats;
    d_out.depth = j->weights;
    grads.rotation = camera;
    grads.translation = camera + 3;
    grads.code = j->code_size ? take_floats(j->code_size) : NULL;
    double start = seconds_now();
    dist_render(j->ctx, j->field, j->camera, &cold, &out, tape);
    dist_render_backward(j->ctx, tape, &d_out, &grads);
    r->gradient_seconds = seconds_now() - start;
    check(j->ctx);
    r->gradient_queries = (double)(stats.queries + stats.backward_points);
    judge_gradient(6, camera, j->exact, &r->camera_cosine, &r->camera_error);
    judge_gradient(j->code_size, grads.code, j->exact + 6, &r->code_cosine, &r->code_error);
    dist_tape_destroy(tape);
    free(out.depth);
    free(grads.code);
}

/* One picture; a warm one starts in the tape from that of a code close by, which is not counted. */
static double render_once(const subject *j, const dist_render_desc *how, const dist_images *out, dist_tape *tape)
{
    if (tape) {
        dist_stats stats;
        dist_images before;
        memset(&before, 0, sizeof before);
        before.distance = out->distance;
        before.silhouette = out->silhouette;
        before.mask = out->mask;
        before.stats = &stats;
        if (j->code_size) {
            float *code = take_floats(j->code_size);
            for (size_t i = 0; i < j->code_size; i++) { code[i] = j->code[i] * (1 + (i % 2 ? 5e-4f : -5e-4f)); }
            dist_shape_set_code(j->shape, code);
            free(code);
        }
        dist_render(j->ctx, j->field, j->camera, how, &before, tape);
        if (j->code_size) { dist_shape_set_code(j->shape, j->code); }
    }
    memset(out->stats, 0, sizeof *out->stats);
    double start = seconds_now();
    dist_render(j->ctx, j->field, j->camera, how, out, tape);
    double seconds = seconds_now() - start;
    check(j->ctx);
    return seconds;
}

enum { RUNS = 7 };

/* Times at most `runs` pictures, but after the first only what fits `limit` seconds, into r; the last one's planes and
   stats stay in `out`. */
static void time_pictures(const subject *j, const dist_render_desc *how, const dist_images *out, dist_tape *tape,
                          int runs, double limit, row *r)
{
    double seconds[RUNS];
    for (int i = 0; i < runs; i++) {
        seconds[i] = render_once(j, how, out, tape);
        if (i == 0 && runs * seconds[0] > limit) { runs = (int)fmax(1, limit / seconds[0]); }
    }
    r->runs = runs;
    r->seconds = median((size_t)runs, seconds);
    r->fastest = seconds[0];
    r->slowest = seconds[runs - 1];
    r->queries = (double)out->stats->queries;
    r->operations = out->stats->operations_done;
}

/* Renders for the time, then once more with the silhouette, once with all planes to judge, and once with a gradient. */
static row picture(const subject *j, const dist_render_desc *how, int dense, int runs, double limit)
{
    row r;
    dist_stats stats;
    dist_images out;
    size_t n = j->ref->n;
    dist_tape *tape = how->warm_start ? dist_tape_create(j->ctx, j->camera, how) : NULL;
    uint32_t all_alive = j->shape ? j->shape->all_alive : 0;
    int groups = j->shape ? j->shape->groups : 0;
    check(j->ctx);
    memset(&r, 0, sizeof r);
    memset(&out, 0, sizeof out);
    out.distance = take_floats(n);
    out.mask = (unsigned char *)take(n, 1);
    out.stats = &stats;
    if (dense && j->shape) {
        j->shape->all_alive = ~(uint32_t)0;
        j->shape->groups = 0;
    }
    time_pictures(j, how, &out, tape, runs, limit, &r);
    out.silhouette = take_floats(n);
    if (tape) { render_once(j, how, &out, tape); } /* the tape knows the silhouette from now on */
    r.silhouette_seconds = render_once(j, how, &out, tape);
    r.silhouette_queries = (double)stats.queries;
    out.normal = take_floats(3 * n);
    out.error = take_floats(n);
    out.status = (unsigned char *)take(n, 1);
    render_once(j, how, &out, tape);
    compare(j->ref, &out, (double)stats.epsilon, &r);
    if (dense && j->shape) {
        j->shape->all_alive = all_alive;
        j->shape->groups = groups;
    }
    gradient(j, how, &r);
    dist_tape_destroy(tape);
    free(out.distance);
    free(out.mask);
    free(out.normal);
    free(out.silhouette);
    free(out.error);
    free(out.status);
    return r;
}

/* A gradient's cosine and error; empty where there is none. */
static const char *gradient_cells(char text[64], double cosine, double error)
{
    if (error >= 0) { snprintf(text, 64, "%.8f,%.3e", cosine, error); } else { strcpy(text, ","); }
    return text;
}

/* In one piece, as other cases may be at it, too. */
static void print_row(const row *r)
{
    char code[64], camera[64];
    double pixels = (double)r->window * (double)r->window;
    printf("%s,%s,%s,%.3g,%d,%.0f,%.4f,%.1f,%.5f,%.3e,%.3e,%.3e,%.0f,%.0f,%.4g,%.3e,%.4g,%d,%.5f,%.5f,%.0f,%.0f,%.4g,"
           "%.0f,%.5f,%.3e,%.0f,%s,%s,%.0f,%.5f,%d\n",
           r->s->name, r->m->name, r->parameter, r->value, r->size, r->queries, r->queries / pixels,
           r->operations / pixels, r->seconds, r->mean, r->p99, r->largest, (double)r->holes, (double)r->false_hits,
           r->normal, r->silhouette, r->violations, r->runs, r->fastest, r->slowest, (double)r->hits,
           (double)r->unresolved, r->touched, r->silhouette_queries, r->silhouette_seconds, r->near,
           r->gradient_queries, gradient_cells(code, r->code_cosine, r->code_error),
           gradient_cells(camera, r->camera_cosine, r->camera_error), (double)r->compared, r->gradient_seconds, r->window);
    fflush(stdout);
}

/* A row that tells costs alone. */
static void print_costs(const row *r)
{
    double pixels = (double)r->window * (double)r->window;
    printf("%s,%s,%s,%.3g,%d,%.0f,%.4f,%.1f,%.5f,,,,,,,,,%d,%.5f,%.5f,%.0f,,,,,,,,,,,,,%d\n", r->s->name, r->m->name,
           r->parameter, r->value, r->size, r->queries, r->queries / pixels, r->operations / pixels, r->seconds,
           r->runs, r->fastest, r->slowest, (double)r->hits, r->window);
    fflush(stdout);
}

/* ---- plots ------------------------------------------------------------------------------------------------------- */

/* Whether more than 1 in 1000 hits is off by more than its bound; a single one of a small picture is not. */
static int beyond_bound(const row *r)
{
    return r->violations > 1 && r->beyond > 1;
}

/* A failed picture; a wrong pixel or two of a small one are not. */
static int failed(const row *r)
{
    double wrong = (double)(r->holes + r->false_hits);
    return wrong > fmax(2, 1e-3 * (double)r->true_hits) || (r->m->trace != DIST_TRACE_PAPER && beyond_bound(r));
}

/* A panel: error `y` over what it costs. */
enum { OVER_QUERIES, OVER_SECONDS, OVER_OPERATIONS };
enum { Y_MEAN, Y_P99, Y_MAX, Y_WRONG, Y_NORMAL, Y_NEAR, Y_CODE, Y_CAMERA, Y_CODE_ANGLE, Y_CAMERA_ANGLE };

typedef struct panel_of {
    const char *title;
    int y, over;
    double least;
} panel_of;

static const panel_of panels[] = {
    {"distance, mean", Y_MEAN, OVER_QUERIES, 1e-8},
    {"distance, 99 % of the hits", Y_P99, OVER_QUERIES, 1e-8},
    {"distance, largest", Y_MAX, OVER_QUERIES, 1e-8},
    {"holes and false hits per pixel to hit", Y_WRONG, OVER_QUERIES, 1e-5},
    {"normals, 99 % of the hits, degrees", Y_NORMAL, OVER_QUERIES, 1e-4},
    {"silhouette near the outline, mean", Y_NEAR, OVER_QUERIES, 1e-8},
    {"gradient for the camera, relative", Y_CAMERA, OVER_QUERIES, 1e-7},
    {"gradient for the code, relative", Y_CODE, OVER_QUERIES, 1e-7},
    {"for the camera, 1 - cosine", Y_CAMERA_ANGLE, OVER_QUERIES, 1e-12},
    {"for the code, 1 - cosine", Y_CODE_ANGLE, OVER_QUERIES, 1e-12},
    {"distance, 99 % of the hits", Y_P99, OVER_SECONDS, 1e-8},
    {"holes and false hits per pixel to hit", Y_WRONG, OVER_SECONDS, 1e-5},
    {"silhouette near the outline, mean", Y_NEAR, OVER_SECONDS, 1e-8},
    {"gradient for the camera, relative", Y_CAMERA, OVER_SECONDS, 1e-7},
    {"gradient for the code, relative", Y_CODE, OVER_SECONDS, 1e-7},
    {"distance, 99 % of the hits", Y_P99, OVER_OPERATIONS, 1e-8},
};
enum { PANELS = sizeof panels / sizeof panels[0] };

static double plot_x(const row *r, const panel_of *v)
{
    double pixels = (double)r->window * (double)r->window;
    if (v->over == OVER_SECONDS && v->y >= Y_CODE) { return r->gradient_seconds; }
    if (v->over == OVER_SECONDS) { return v->y == Y_NEAR ? r->silhouette_seconds : r->seconds; }
    if (v->over == OVER_OPERATIONS) { return r->operations / pixels; }
    if (v->y >= Y_CODE) { return r->gradient_queries / pixels; }
    return (v->y == Y_NEAR ? r->silhouette_queries : r->queries) / pixels;
}

static double plot_y(const row *r, const panel_of *v)
{
    switch (v->y) {
    case Y_MEAN: return r->mean;
    case Y_P99: return r->p99;
    case Y_MAX: return r->largest;
    case Y_WRONG: return (double)(r->holes + r->false_hits) / (double)(r->true_hits ? r->true_hits : 1);
    case Y_NORMAL: return r->normal;
    case Y_NEAR: return r->near;
    case Y_CODE: return r->code_error;
    case Y_CAMERA: return r->camera_error;
    case Y_CODE_ANGLE: return r->code_error < 0 ? -1 : fmax(0, 1 - r->code_cosine);
    default: return r->camera_error < 0 ? -1 : fmax(0, 1 - r->camera_cosine);
    }
}

/* The line that a row belongs to: its method, or a sweep of alpha or of the budget. */
static const char *line_of(const row *r, char room[64])
{
    if (strcmp(r->parameter, "alpha") != 0 && strcmp(r->parameter, "steps") != 0) { return r->m->name; }
    snprintf(room, 64, "%.40s, %s", r->m->name, r->parameter);
    return room;
}

/* Rows that differ in their gradient alone are shown among the gradients alone. */
static int shown(const row *r, const panel_of *v)
{
    int of_gradient = v->y >= Y_CODE;
    if (!of_gradient && (r->m->gradient || r->m->uncapped)) { return 0; }
    if (of_gradient && (r->m->warm || r->m->dense || r->m->half)) { return 0; }
    return plot_y(r, v) >= 0 && (v->over != OVER_OPERATIONS || r->operations > 0);
}

/* All rows of one case and size. */
static void plot_rows(const char *stem, const row *rows, size_t n)
{
    static const char *const x_labels[] = {"queries per pixel", "seconds", "multiply-adds done per pixel"};
    char name[PATH_SIZE], path[PATH_SIZE], title[128], of[64] = "", lines[3][64];
    if (rows->window < rows->size) { snprintf(of, sizeof of, " (%d x %d of it)", rows->window, rows->window); }
    snprintf(title, sizeof title, "%s, %d x %d%s: error against cost", rows->s->name, rows->size, rows->size, of);
    snprintf(name, sizeof name, "_%s_%d.svg", rows->s->name, rows->size);
    plot p = plot_begin(title, "against a reference in double; at the low edge: no larger than told there", 4);
    p.panel_width = 250;
    p.panel_height = 190;
    memset(lines, 0, sizeof lines);
    for (int k = 0; k < PANELS; k++) {
        const panel_of *v = &panels[k];
        int any = 0;
        for (size_t i = 0; i < n; i++) { any |= shown(rows + i, v); }
        if (!any) { continue; }
        plot_panel *a = plot_add_panel(&p, v->title, x_labels[v->over], NULL, PLOT_LOG_X | PLOT_LOG_Y);
        a->least[1] = v->least;
        for (size_t i = 0; i < n; i++) {
            const row *r = rows + i;
            char room[64];
            const char *text = line_of(r, room);
            if (!shown(r, v)) { continue; }
            if (text == room) { /* a text that stays */
                int j = 0;
                while (lines[j][0] && strcmp(lines[j], room) != 0) { j++; }
                memcpy(lines[j], room, sizeof room);
                text = lines[j];
            }
            int first = strcmp(r->parameter, "default") == 0; /* beside the line of its method's epsilons */
            plot_series *s = plot_series_of(a, text);
            s->dashed = r->m->trace == DIST_TRACE_PAPER;
            if (first) { continue; }
            plot_point *q = plot_add(s, plot_x(r, v), plot_y(r, v));
            q->open = failed(r);
            if (v->over == OVER_SECONDS && v->y < Y_NEAR) { q->x_low = r->fastest, q->x_high = r->slowest; }
        }
        for (size_t i = 0; i < n; i++) {
            const row *r = rows + i;
            if (strcmp(r->parameter, "default") != 0 || !shown(r, v)) { continue; }
            plot_series *s = plot_add_series(a, r->m->name);
            s->no_line = s->hidden = 1;
            plot_point *q = plot_add(s, plot_x(r, v), plot_y(r, v));
            q->open = failed(r);
            q->size = 1.6;
        }
    }
    p.open_means = "failed: more than 1 in 1000 pixels wrong, or hits of ours beyond their bound";
    p.notes[0] = "lines: epsilon 1e-2 to 1e-7, or as named; large: defaults";
    p.notes[1] = "dashed: the paper's tracer";
    plot_write(&p, path_of(path, stem, name), bench_origin());
}

/* ---- the sweep --------------------------------------------------------------------------------------------------- */

static const double epsilons[] = {1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7};
static const double alphas[] = {1.0, 1.2, 1.4, 1.6, 1.8, 1.9};
static const double budgets[] = {10, 20, 30, 50};

/* The same net with its weights in 16 bits as well; shape NULL: not to be had here. */
typedef struct half {
    dist_net *net;
    dist_shape *shape;
    dist_field field;
} half;

typedef struct sweep {
    subject subject;
    dist_camera camera;
    reference ref;
    half halves[2]; /* F16, BF16 */
    int quick, size, window; /* window: 0, the scene's */
    double limit;            /* seconds to time a row in */
    const char *have;        /* csv of an earlier run; NULL: none */
    const char *svg;         /* stem of the plots' names; NULL: none */
    row *rows;
    size_t count;
} sweep;

static half half_create(dist_context *ctx, const scene *s, const float *code, int kind)
{
    half h;
    memset(&h, 0, sizeof h);
    h.net = load_net_or_skip(ctx, s->net);
    if (dist_net_set_half(ctx, h.net, kind) != DIST_OK) {
        dist_context_clear(ctx);
        return h;
    }
    h.shape = dist_shape_create(ctx, h.net, code);
    check(ctx);
    h.field = dist_shape_field(h.shape);
    h.field.eval_fn = h.field.coarse_fn;
    return h;
}

static dist_render_desc how_of(const method *m, const char *parameter, double value)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.trace = m->trace;
    how.paper_row = m->row;
    how.max_steps = m->steps;
    how.no_cones = m->no_cones;
    how.no_prediction = m->no_prediction;
    how.certified = m->certified;
    how.gradient = m->gradient;
    how.samples = m->samples;
    how.warm_start = m->warm;
    how.gradient_cap = m->uncapped ? 1e-6f : 0;
    how.normal_space = DIST_SPACE_WORLD;
    if (strcmp(parameter, "epsilon") == 0) { how.epsilon = (float)value; }
    if (strcmp(parameter, "alpha") == 0) { how.step_scale = (float)value; }
    if (strcmp(parameter, "steps") == 0) { how.max_steps = (int)value; }
    return how;
}

/* The row that has the picture of m, which differs from its method in the gradient alone; NULL: none. */
static const row *picture_of(const sweep *w, const method *m, const char *parameter, double value)
{
    if (!m->gradient && !m->uncapped) { return NULL; }
    for (size_t i = w->count; i-- > 0;) {
        const row *r = &w->rows[i];
        if (r->m == &methods[m->trace == DIST_TRACE_PAPER ? COARSE_TO_FINE : GUARDED] && r->size == w->size &&
            strcmp(r->parameter, parameter) == 0 && r->value == value) {
            return r;
        }
    }
    return NULL;
}

static void add_row(sweep *w, const method *m, const char *parameter, double value)
{
    subject j = w->subject;
    if (m->half) {
        half *h = &w->halves[m->half == DIST_HALF_BF16];
        j.field = &h->field;
        j.shape = h->shape;
    }
    if (w->count == MOST_ROWS) { fail("more than %d rows", MOST_ROWS); }
    dist_render_desc how = how_of(m, parameter, value);
    row r;
    const row *known = picture_of(w, m, parameter, value);
    if (known) {
        r = *known;
        gradient(&j, &how, &r);
    } else {
        r = picture(&j, &how, m->dense, w->quick ? 3 : RUNS, w->limit);
    }
    r.s = j.s;
    r.m = m;
    r.parameter = parameter;
    r.value = value;
    r.size = w->size;
    r.window = w->camera.width;
    print_row(&r);
    w->rows[w->count++] = r;
}

/* One parameter's values with every method. Those of a quick sweep are every second of all. */
static void sweep_values(sweep *w, const char *parameter, size_t count, const double *values)
{
    int alpha = strcmp(parameter, "alpha") == 0, steps = strcmp(parameter, "steps") == 0;
    for (const method *m = methods; m < methods + METHODS; m++) {
        if ((alpha && !m->by_alpha) || (steps && !m->by_steps)) { continue; }
        if ((m->dense || m->half) && !w->subject.shape) { continue; }
        if (m->warm && !w->subject.code_size) { continue; }
        if (m->half && !w->halves[m->half == DIST_HALF_BF16].shape) {
            if (strcmp(parameter, "default") != 0) { continue; }
            printf("%s,%s,not available,,%d%s\n", w->subject.s->name, m->name, w->size, EMPTY);
            continue;
        }
        for (size_t i = 0; i < count; i += w->quick ? 2 : 1) { add_row(w, m, parameter, values[i]); }
    }
}

/* Of the windows of `side` pixels with at least half the whole picture's share of hits the one whose shares of hits and
   of rays that meet the bounding sphere are nearest the whole picture's; the first of several. x, y: its first column
   and row. */
static void choose_window(const dist_field *field, const dist_camera *camera, const unsigned char *mask, int side,
                          int *x, int *y)
{
    int n = camera->width, step = side / 4;
    size_t columns = (size_t)n + 1;
    double *sums[2], best = 1e30; /* over all pixels above and to the left: hits, rays */
    disti_view eye;
    disti_view_of(camera, &eye);
    for (int k = 0; k < 2; k++) { sums[k] = (double *)take(columns * columns, sizeof(double)); }
    for (int i = 0; i < n * n; i++) {
        ray r;
        size_t at = ((size_t)(i / n) + 1) * columns + (size_t)(i % n) + 1;
        double of[2] = {mask[i] != 0, ray_of(field, camera, &eye, i, &r)};
        for (int k = 0; k < 2; k++) {
            sums[k][at] = of[k] + sums[k][at - 1] + sums[k][at - columns] - sums[k][at - columns - 1];
        }
    }
    for (int v = 0; v + side <= n; v += step) {
        for (int u = 0; u + side <= n; u += step) {
            double off = 0, hits = 0;
            for (int k = 1; k >= 0; k--) {
                const double *low = sums[k] + (size_t)v * columns + (size_t)u, *high = low + (size_t)side * columns;
                hits = (high[side] - high[0] - low[side] + low[0]) / side / side;
                off += fabs(hits - sums[k][columns * columns - 1] / n / n);
            }
            if (off < best && hits >= 0.5 * sums[0][columns * columns - 1] / n / n) { best = off, *x = u, *y = v; }
        }
    }
    free(sums[0]);
    free(sums[1]);
}

/* Prints what the default of the first method takes for the whole picture, and makes the camera that of its window. */
static void narrow(sweep *w, int side)
{
    row r;
    dist_stats stats;
    dist_images out;
    dist_render_desc how = how_of(methods, "default", 0);
    size_t n = (size_t)w->size * (size_t)w->size;
    int x = 0, y = 0;
    memset(&r, 0, sizeof r);
    memset(&out, 0, sizeof out);
    out.distance = take_floats(n);
    out.mask = (unsigned char *)take(n, 1);
    out.stats = &stats;
    time_pictures(&w->subject, &how, &out, NULL, w->quick ? 3 : RUNS, w->limit, &r);
    for (size_t i = 0; i < n; i++) { r.hits += out.mask[i] != 0; }
    r.s = w->subject.s;
    r.m = methods;
    r.parameter = "whole";
    r.size = r.window = w->size;
    print_costs(&r);
    choose_window(w->subject.field, &w->camera, out.mask, side, &x, &y);
    w->camera.width = w->camera.height = side;
    w->camera.cx -= (float)x;
    w->camera.cy -= (float)y;
    free(out.distance);
    free(out.mask);
}

/* One row of a csv, that of print_row; 0: it is none with errors. */
static int parse_row(const char *line, const scene *s, row *r)
{
    static const char *const parameters[] = {"default", "epsilon", "alpha", "steps"};
    enum { TEXTS = 3, NUMBERS = 34 };
    double n[NUMBERS];
    char text[TEXTS][64];
    for (int k = 0; k < NUMBERS; k++) {
        size_t length = strcspn(line, ",\n");
        char *end = NULL;
        if (k < TEXTS) {
            if (length >= sizeof text[k]) { return 0; }
            memcpy(text[k], line, length);
            text[k][length] = 0;
        }
        n[k] = length ? strtod(line, &end) : -1; /* -1: there is none */
        line += length;
        if (k >= TEXTS && length && end != line) { return 0; }
        if (*line != (k == NUMBERS - 1 ? '\n' : ',')) { return 0; }
        line++;
    }
    memset(r, 0, sizeof *r);
    r->s = s;
    for (const method *m = methods; m < methods + METHODS; m++) { r->m = strcmp(m->name, text[1]) == 0 ? m : r->m; }
    for (int k = 0; k < 4; k++) { r->parameter = strcmp(parameters[k], text[2]) == 0 ? parameters[k] : r->parameter; }
    if (strcmp(text[0], s->name) != 0 || !r->m || !r->parameter || n[9] < 0) { return 0; }
    static const int counts[] = {4, 12, 13, 17, 20, 21, 31, 33};
    for (size_t k = 0; k < sizeof counts / sizeof counts[0]; k++) {
        if (!(n[counts[k]] >= 0 && n[counts[k]] <= 1e9)) { return 0; }
    }
    r->value = n[3], r->size = (int)n[4], r->window = (int)n[33];
    r->queries = n[5], r->operations = n[7] * n[33] * n[33], r->seconds = n[8];
    r->mean = n[9], r->p99 = n[10], r->largest = n[11];
    r->holes = (size_t)n[12], r->false_hits = (size_t)n[13];
    r->normal = n[14], r->silhouette = n[15], r->violations = n[16];
    r->runs = (int)n[17], r->fastest = n[18], r->slowest = n[19];
    r->hits = (size_t)n[20], r->unresolved = (size_t)n[21], r->touched = n[22];
    r->silhouette_queries = n[23], r->silhouette_seconds = n[24], r->near = n[25];
    r->gradient_queries = n[26], r->code_cosine = n[27], r->code_error = n[28];
    r->camera_cosine = n[29], r->camera_error = n[30];
    r->compared = (size_t)n[31], r->gradient_seconds = n[32];
    r->true_hits = r->hits + r->holes - r->false_hits;
    r->beyond = floor(r->violations * (double)(r->hits - r->false_hits) / 1000 + 0.5);
    return 1;
}

/* The line behind this one, of the csv of an earlier run; *length: this one's, with its end. */
static const char *next_line(const char *line, size_t *length)
{
    *length = strcspn(line, "\n");
    *length += line[*length] == '\n';
    return line + *length;
}

/* Whether a line of a csv is of this scene and size: its first field and its fifth. */
static int is_of(const sweep *w, const char *line)
{
    char size[16];
    size_t name = strlen(w->subject.s->name);
    if (strncmp(line, w->subject.s->name, name) != 0 || line[name] != ',') { return 0; }
    for (int k = 0; k < 3 && line; k++) { line = strchr(line + name + 1, ','), name = 0; }
    snprintf(size, sizeof size, ",%d,", w->size);
    return line && strncmp(line, size, strlen(size)) == 0;
}

/* Whether it tells of a whole picture: its third field. It is no row of the sweep. */
static int is_whole(const char *line)
{
    for (int k = 0; k < 2 && line; k++) { line = strchr(line, ','), line += line != NULL; }
    return line && strncmp(line, "whole,", 6) == 0;
}

/* Takes over the rows of this size from an earlier run. 0: it had not finished it, or one of them is damaged. */
static int take_rows(sweep *w)
{
    size_t first = w->count, length = 0, last = sizeof budgets / sizeof budgets[0] - 1;
    int damaged = 0;
    last -= w->quick ? last % 2 : 0;
    for (const char *line = w->have, *next; line && *line; line = next) {
        next = next_line(line, &length);
        if (!is_of(w, line)) { continue; }
        if (w->count == MOST_ROWS) { fail("more than %d rows", MOST_ROWS); }
        if (parse_row(line, w->subject.s, &w->rows[w->count])) { w->count++; }
        else { damaged |= !is_whole(line); }
    }
    const row *r = w->count > first ? &w->rows[w->count - 1] : NULL;
    if (damaged || !r || strcmp(r->parameter, "steps") != 0 || r->value < budgets[last]) {
        w->count = first;
        return 0;
    }
    for (const char *line = w->have, *next; *line; line = next) {
        next = next_line(line, &length);
        if (is_of(w, line)) { printf("%.*s", (int)length, line); }
    }
    fflush(stdout);
    fprintf(stderr, "done %s %d: %d rows, by an earlier run\n", w->subject.s->name, w->size, (int)(w->count - first));
    return 1;
}

/* One field at one size. */
static void sweep_field(sweep *w, int size)
{
    static const double none[1] = {0};
    size_t first = w->count;
    double start = seconds_now();
    subject *j = &w->subject;
    int side = w->window ? w->window : j->s->window;
    w->size = size;
    if (take_rows(w)) {
        if (w->svg) { plot_rows(w->svg, w->rows + first, w->count - first); }
        return;
    }
    w->camera = camera_of(j->s, j->field, size);
    j->camera = &w->camera;
    if (side < size) { narrow(w, side); }
    w->ref = reference_create(j->ctx, j->s, j->field, j->e, &w->camera);
    j->ref = &w->ref;
    j->exact = (double *)take(6 + j->code_size, sizeof(double));
    j->weights = take_floats(w->ref.n);
    exact_gradient(j);
    double begin = seconds_now();
    sweep_values(w, "default", 1, none);
    sweep_values(w, "epsilon", sizeof epsilons / sizeof epsilons[0], epsilons);
    sweep_values(w, "alpha", sizeof alphas / sizeof alphas[0], alphas);
    sweep_values(w, "steps", sizeof budgets / sizeof budgets[0], budgets);
    reference_destroy(&w->ref);
    free(j->exact);
    free(j->weights);
    if (w->svg && w->count > first) { plot_rows(w->svg, w->rows + first, w->count - first); }
    fprintf(stderr, "done %s %d: %d rows in %.1f s, and %.1f s for the reference\n", j->s->name, size,
            (int)(w->count - first), seconds_now() - begin, begin - start);
}

/* w: a scene's own, with its rows. */
static void run_scene(sweep *w, const scene *s, int workers, int only_size, int largest)
{
    scene copy;
    dist_field field;
    exact e;
    dist_shape *shape = NULL;
    dist_context_desc settings = {.workers = workers};
    dist_context *ctx = w->subject.ctx = dist_context_create(&settings);
    check(ctx);
    dist_net *net = s->net ? load_net_or_skip(ctx, s->net) : NULL;
    if (s->net && !net) {
        dist_context_destroy(ctx);
        return;
    }
    if (net) {
        const float *code = dist_net_code(net, s->code);
        if (dist_net_code_size(net) && !code) { fail("%s has no code %d", s->name, s->code); }
        shape = dist_shape_create(ctx, net, code);
        check(ctx);
        field = dist_shape_field(shape);
        e = exact_create(net, code);
        for (int k = 0; k < 2; k++) { w->halves[k] = half_create(ctx, s, code, k ? DIST_HALF_BF16 : DIST_HALF_F16); }
        w->subject.code = code;
    } else {
        field = analytic_field(s, &copy);
    }
    w->subject.s = s;
    w->subject.field = &field;
    w->subject.shape = shape;
    w->subject.e = net ? &e : NULL;
    w->subject.code_size = net ? (size_t)dist_net_code_size(net) : 0;
    int last = only_size ? only_size : largest;
    for (int size = only_size ? only_size : 64; size <= last; size *= 2) {
        sweep_field(w, size);
    }
    for (int k = 0; k < 2; k++) {
        dist_shape_destroy(w->halves[k].shape);
        dist_net_destroy(w->halves[k].net);
    }
    if (net) { exact_destroy(&e); }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* ---- where it does badly ----------------------------------------------------------------------------------------- */

/* What a picture is judged by, and what does not matter of it. */
enum { P99, NORMAL, NEAR_SILHOUETTE, SILHOUETTE, HOLES, FALSE_HITS, CODE, CAMERA, METRICS };
static const char *const metric_names[METRICS] = {"p99 error", "p99 of the normals' degrees",
                                                  "silhouette error near the outline", "silhouette error", "holes",
                                                  "false hits", "the code's gradient", "the camera's gradient"};
static const double metric_floors[METRICS] = {CLEAR, 0.01, 1e-5, 1e-4, 0, 0, 1e-3, 1e-3};

static double metric(const row *r, int k)
{
    switch (k) {
    case P99: return r->p99;
    case NORMAL: return r->normal;
    case NEAR_SILHOUETTE: return r->near;
    case SILHOUETTE: return r->silhouette;
    case HOLES: return (double)r->holes;
    case CODE: return r->code_error;
    case CAMERA: return r->camera_error;
    default: return (double)r->false_hits;
    }
}

/* Of the rows of the paper's tracer at a's scene and size the best by one metric. */
static const row *best_of_paper(const row *rows, size_t n, const row *a, int k)
{
    const row *best = NULL;
    for (size_t i = 0; i < n; i++) {
        const row *b = rows + i;
        if (b->s != a->s || b->size != a->size || b->m->trace != DIST_TRACE_PAPER) { continue; }
        if (!best || metric(b, k) < metric(best, k)) { best = b; }
    }
    return best;
}

/* As exact as a in distance and mask, for less. */
static int beats(const row *b, const row *a)
{
    if (b->s != a->s || b->size != a->size || b->m->trace != DIST_TRACE_PAPER) { return 0; }
    return b->mean <= fmax(a->mean, CLEAR) && b->p99 <= fmax(a->p99, CLEAR) && b->holes <= a->holes &&
           b->false_hits <= a->false_hits && (b->queries < a->queries || b->seconds < a->seconds);
}

/* Where our own bounds are violated, where a row of the paper's tracer is as exact as our default and cheaper, and
   where one is more than twice as exact by any metric, at whatever cost. */
static void print_worst(const row *rows, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        const row *a = rows + i;
        if (a->m->trace == DIST_TRACE_PAPER) { continue; }
        if (beyond_bound(a) && !a->m->gradient && !a->m->uncapped && !a->m->half) {
            fprintf(stderr, "bound: %s %d %s %s %g: %.2f per mille of %.0f hits off by more, %.2f of them touched\n",
                    a->s->name, a->size, a->m->name, a->parameter, a->value, a->violations, (double)a->hits,
                    a->touched);
        }
        if (strcmp(a->m->name, "guarded") != 0 || strcmp(a->parameter, "default") != 0) { continue; }
        for (size_t j = 0; j < n; j++) {
            const row *b = rows + j;
            if (!beats(b, a)) { continue; }
            fprintf(stderr, "dearer: %s %d than %s %s %g: %.0f queries against %.0f, %.4f s against %.4f\n", a->s->name,
                    a->size, b->m->name, b->parameter, b->value, a->queries, b->queries, a->seconds, b->seconds);
        }
        for (int k = 0; k < METRICS; k++) {
            const row *b = best_of_paper(rows, n, a, k);
            if (!b || metric(a, k) <= fmax(2 * metric(b, k), metric_floors[k])) { continue; }
            fprintf(stderr, "less exact: %s %d than %s %s %g: %s %.2g against %.2g, with %.0f queries against %.0f\n",
                    a->s->name, a->size, b->m->name, b->parameter, b->value, metric_names[k], metric(a, k),
                    metric(b, k), a->queries, b->queries);
        }
    }
}

/* Our default against the best of the paper's rows, whichever that is, by each measure for itself. */
static void plot_losses(const char *stem, const row *rows, size_t n)
{
    char path[PATH_SIZE];
    plot p = plot_begin("Where dist.h loses: its default against the best of all rows of the paper's tracer",
                        "each scene and size, each measure with the row that is best by it; above the line: a loss", 1);
    plot_panel *a = plot_add_panel(&p, "", "queries of that row / of dist.h", "error of dist.h / of that row",
                                   PLOT_LOG_X | PLOT_LOG_Y);
    p.panel_width = 520;
    p.panel_height = 360;
    a->guide = 1;
    a->guide_text = "equal";
    for (int k = 0; k < METRICS; k++) {
        for (size_t i = 0; i < n; i++) {
            const row *r = rows + i, *b = best_of_paper(rows, n, r, k);
            if (!b || strcmp(r->m->name, "guarded") != 0 || strcmp(r->parameter, "default") != 0) { continue; }
            if (metric(r, k) < 0 || b->queries <= 0 || r->queries <= 0) { continue; }
            double least = metric_floors[k] > 0 ? metric_floors[k] : 1; /* as exact as matters, or no wrong pixel */
            plot_series *s = plot_series_of(a, metric_names[k]);
            s->no_line = 1;
            plot_point *q = plot_add(s, b->queries / r->queries, fmax(metric(r, k), least) / fmax(metric(b, k), least));
            q->open = failed(r);
        }
    }
    p.open_means = "dist.h failed: more than 1 in 1000 pixels wrong, or hits beyond their bound";
    p.notes[0] = "errors below what matters, and no wrong pixel against one, count as equal";
    if (a->n) { plot_write(&p, path_of(path, stem, "_losses.svg"), bench_origin()); }
}

/* Scene by scene, the epsilons of one row of each tracer at every size. */
static void plot_sizes(const char *stem, const row *rows, size_t n)
{
    static const char *const ours[] = {"guarded", "paper_coarse_to_fine_50"};
    static char names[2][8][48];
    char path[PATH_SIZE];
    const scene *of = NULL;
    plot_panel *a = NULL;
    plot p = plot_begin("Error against cost as pictures grow", "distance, 99 % of the hits: error over seconds of a "
                        "million pixels; one thread; lines: epsilon 1e-2 to 1e-7", 4);
    p.panel_width = 270;
    p.panel_height = 180;
    for (size_t i = 0; i < n; i++) {
        const row *r = rows + i;
        int k = strcmp(r->m->name, ours[1]) == 0, size = 0;
        if (strcmp(r->parameter, "epsilon") != 0 || strcmp(r->m->name, ours[k]) != 0) { continue; }
        if (r->s != of) {
            of = r->s;
            a = plot_add_panel(&p, of->name, "seconds per million pixels", NULL, PLOT_LOG_X | PLOT_LOG_Y);
            a->least[1] = 1e-8;
        }
        while (size < 7 && (64 << size) < r->size) { size++; }
        snprintf(names[k][size], sizeof names[k][size], "%s, %d", ours[k], r->size);
        plot_series *line = plot_series_of(a, names[k][size]);
        line->dashed = k;
        double scale = 1e6 / ((double)r->window * (double)r->window);
        plot_point *q = plot_add(line, scale * r->seconds, r->p99);
        q->open = failed(r);
        q->x_low = scale * r->fastest, q->x_high = scale * r->slowest;
    }
    p.open_means = "failed: more than 1 in 1000 pixels wrong, or hits of ours beyond their bound";
    p.notes[0] = "at the low edge: no larger than told there";
    p.notes[1] = "of large pictures a window";
    if (p.n) { plot_write(&p, path_of(path, stem, "_sizes.svg"), bench_origin()); }
}

/* Cases that wait: cheap ones are first in the list, slow ones last. */
typedef struct queue {
    int waiting[SCENES];
    int first, end;
} queue;

/* The next case, or -1: every second thread takes them from the end, so that slow ones have cheap ones beside them. */
static int next_case(queue *q, int thread)
{
    int i = -1;
#ifdef _OPENMP
#pragma omp critical
#endif
    if (q->first < q->end) { i = thread % 2 ? q->waiting[--q->end] : q->waiting[q->first++]; }
    return i;
}

int main(int argc, char **argv)
{
    const char *only = NULL;
    char path[PATH_SIZE];
    int only_size = 0, largest = 0, workers = 1, at_once = 1, list = 0;
    sweep common;
    queue cases;
    memset(&common, 0, sizeof common);
    memset(&cases, 0, sizeof cases);
    common.limit = 1e30;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--case")) {
            only = option_text(&o);
        } else if (option_is(&o, "--list")) {
            list = option_flag(&o);
        } else if (option_is(&o, "--size")) {
            only_size = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--largest")) {
            largest = option_int(&o, 64, 4096);
        } else if (option_is(&o, "--window")) {
            common.window = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--seconds")) {
            common.limit = option_number(&o, 0, 1e6);
        } else if (option_is(&o, "--have")) {
            size_t bytes;
            common.have = (const char *)read_file(option_text(&o), &bytes);
        } else if (option_is(&o, "--svg")) {
            common.svg = option_text(&o);
            check_path(path_of(path, common.svg, ".svg"));
        } else if (option_is(&o, "--workers")) {
            workers = option_int(&o, 1, 256);
        } else if (option_is(&o, "--at-once")) {
            at_once = option_int(&o, 1, 256);
        } else if (option_is(&o, "--quick")) {
            common.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    if (!largest) { largest = common.quick ? 64 : 1024; }
    for (int i = 0; i < SCENES; i++) {
        const scene *s = &scenes[i];
        if (list) { puts(s->name); }
        if (only ? strcmp(only, s->name) == 0 : !common.quick || s->quick) { cases.waiting[cases.end++] = i; }
    }
    if (list) { return 0; }
    if (cases.end == 0) { fail("no case is called %s: --list names them", only); }
#ifndef _OPENMP
    if (at_once > 1) { fputs("one case at a time: compiled without OpenMP\n", stderr); }
#endif
    row *rows = (row *)take((size_t)SCENES * MOST_ROWS, sizeof *rows);
    size_t counts[SCENES] = {0}, n = 0;
    puts("case,method,parameter,value,resolution,queries,queries_per_pixel,operations_per_pixel,seconds,mean_error,"
         "p99_error,max_error,holes,false_hits,normal_p99_degrees,silhouette_mean_error,bound_violations_per_mille,"
         "runs,seconds_min,seconds_max,hits,unresolved,touched_per_mille,queries_with_silhouette,"
         "seconds_with_silhouette,silhouette_near_mean_error,gradient_queries,code_cosine,code_norm_error,"
         "camera_cosine,camera_norm_error,pixels_compared,gradient_seconds,window");
    fflush(stdout);
#ifdef _OPENMP
#pragma omp parallel num_threads(at_once)
#endif
    {
        int me = 0;
#ifdef _OPENMP
        me = omp_get_thread_num();
#endif
        for (int i = next_case(&cases, me); i >= 0; i = next_case(&cases, me)) {
            sweep w = common;
            w.rows = rows + (size_t)i * MOST_ROWS;
            run_scene(&w, &scenes[i], workers, only_size, largest);
            counts[i] = w.count;
        }
    }
    for (size_t i = 0; i < SCENES; i++) { /* together */
        memmove(rows + n, rows + i * MOST_ROWS, counts[i] * sizeof *rows);
        n += counts[i];
    }
    print_worst(rows, n);
    fprintf(stderr, "in all: %d rows\n", (int)n);
    if (common.svg) {
        plot_sizes(common.svg, rows, n);
        plot_losses(common.svg, rows, n);
    }
    free(rows);
    return 0;
}
