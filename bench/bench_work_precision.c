/* SPDX-License-Identifier: MIT-0
   bench_work_precision.c - error against cost: what each tracer's pictures are off by, and what they took, as epsilon,
   alpha and the budget of steps change. CSV on stdout; on stderr, in the end, where dist.h does badly.

   The reference is found by small steps and bisection in double; of a network only the points are in double, its
   values are dist_field_eval's. The steps are those that the true slope proves (2.6 for networks), but at least 1e-5
   (networks: 5e-4). Wrong pixels are counted against the surface itself, not against its epsilon:
       hole        the ray goes in by more than CLEAR, and mask is 0
       false hit   mask is 1, and the ray keeps farther than CLEAR from the surface; or misses the bounding sphere
   Errors are those of the distance at the pixels that are hit in both; a bound is violated where the error is larger
   than the plane `error` and CLEAR. `touched`: such pixels whose ray came within epsilon of the surface before, without
   crossing it, which may count as a hit by the definition of epsilon; they are among the violations. The silhouette is
   compared at the misses, and `near` at those whose ray comes within NEAR of the surface. operations: multiply-adds
   that were done, without those of dead units; 0 without a network.
   Queries, operations and seconds are those of a picture of distance and mask alone; seconds: median of `runs`. With
   the silhouette they are queries_with_silhouette and, of one run, seconds_with_silhouette.

   --svg draws each case and size: four errors over queries per pixel and over seconds. Lines join the epsilons of one
   method; circles are of epsilon and the default, squares of alpha, diamonds of the budget of steps. A marker is open
   where the picture failed: more than 1 in 1000 pixels that should be hit is wrong, or as many hits of our own are
   farther off than their bound. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"

static const char usage[] =
    "bench_work_precision [options]\n"
    "  --case NAME        only this one\n"
    "  --size N           only pictures of N x N (default 64, 128, 256 and 512)\n"
    "  --long             also 1024, and the decoders of 8 x 512 and with layer norm\n"
    "  --svg STEM         also plots, STEM_CASE_N.svg\n"
    "  --workers N        threads (default 1: then seconds vary least)\n"
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
    int slow;
} scene;

static const scene scenes[] = {
    {"sphere", NULL, SPHERE, {0.8, 0, 0}, 0, 1, 25, 0, 0, 1, 0},
    {"plate_1e-3", NULL, BOX, {0.6, 0.5, 5e-4}, 0, 1, 25, 0, 0, 1, 0},
    {"rods_1e-3", NULL, RODS, {1e-3, 0, 0}, 0, 1, 25, 0, 0, 1, 0},
    {"torus_grazing", NULL, TORUS, {0.66, 0.22, 0}, 0, 1, 19.3, 0, 0, 1, 0},
    {"bumps_slope_2", NULL, BUMPS, {0.7, 0.05, 20}, 0, 2, 25, 0, 0, 1, 0},
    {"box_clamped", NULL, BOX, {0.4, 0.5, 0.3}, 0.1, 1, 25, 0, 0, 1, 0},
    {"empty", NULL, SPHERE, {0.15, 0, 0}, 0, 1, 25, 0, 1, 1, 0},
    {"embedded_5", "embedded", 0, {0, 0, 0}, 0, 2.6, 25, 5, 0, 1, 0},
    {"fox", "fox", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 1, 0},
    {"rings", "rings", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 0},
    {"bunny_relu", "bunny_relu", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 0},
    {"two_spheres_sine", "two_spheres_sine", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 0},
    {"spot", "bob_spot", 0, {0, 0, 0}, 0, 2.6, 25, 1, 0, 0, 0},
    {"round_cross_10", "round_cross", 0, {0, 0, 0}, 0, 2.6, 25, 10, 0, 0, 0},
    {"mug", "mug_camera_bottle", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 0},
    {"chairs_3", "chairs", 0, {0, 0, 0}, 0, 2.6, 25, 3, 0, 0, 1},
    {"spot_512", "deepsdf_512", 0, {0, 0, 0}, 0, 2.6, 25, 0, 0, 0, 1},
};

typedef struct method {
    const char *name;
    int trace, row, steps, no_cones, no_prediction, certified, by_alpha, by_steps;
} method;

static const method methods[] = {
    {"paper_parallel_50", DIST_TRACE_PAPER, DIST_PAPER_PARALLEL, 50, 0, 0, 0, 0, 0},
    {"paper_dynamic_50", DIST_TRACE_PAPER, DIST_PAPER_DYNAMIC, 50, 0, 0, 0, 0, 0},
    {"paper_aggressive_50", DIST_TRACE_PAPER, DIST_PAPER_AGGRESSIVE, 50, 0, 0, 0, 1, 0},
    {"paper_coarse_to_fine_50", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 50, 0, 0, 0, 0, 0},
    {"paper_parallel_100", DIST_TRACE_PAPER, DIST_PAPER_PARALLEL, 100, 0, 0, 0, 0, 0},
    {"paper_dynamic_100", DIST_TRACE_PAPER, DIST_PAPER_DYNAMIC, 100, 0, 0, 0, 0, 0},
    {"paper_aggressive_100", DIST_TRACE_PAPER, DIST_PAPER_AGGRESSIVE, 100, 0, 0, 0, 0, 0},
    {"paper_coarse_to_fine_100", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 100, 0, 0, 0, 0, 0},
    {"guarded", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0, 1, 1},
    {"guarded_no_prediction", DIST_TRACE_GUARDED, 0, 0, 0, 1, 0, 0, 0},
    {"guarded_no_cones", DIST_TRACE_GUARDED, 0, 0, 1, 0, 0, 0, 0},
    {"certified", DIST_TRACE_GUARDED, 0, 0, 0, 0, 1, 0, 0},
};

enum { SCENES = sizeof scenes / sizeof scenes[0], METHODS = sizeof methods / sizeof methods[0], MOST_ROWS = 16384 };

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

enum { REF_OUTSIDE = 0, REF_MISS, REF_HIT, REF_BARELY, REF_INSIDE }; /* barely: goes in by no more than CLEAR */

typedef struct reference {
    size_t n, in_sphere, hits;
    double origin[3];
    double *distance, *smallest; /* smallest f, of rays that miss */
    double *dip;                 /* lowest f before the crossing from which it rose again */
    float *normal;               /* (n, 3) */
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
    float *points, *sdf, *gradient;
} prober;

/* f of each ray at its t, into sdf of double. gradient: of the field, if not NULL. */
static void probe(const prober *p, size_t n, const ray *rays, double *sdf, float *gradient)
{
    for (size_t i = 0; i < n; i++) {
        double at[3];
        double g[3];
        for (int a = 0; a < 3; a++) {
            at[a] = p->origin[a] + rays[i].t * rays[i].d[a];
            p->points[3 * i + (size_t)a] = (float)at[a];
        }
        if (p->s->net) { continue; }
        sdf[i] = value_of(p->s, at);
        if (!gradient) { continue; }
        gradient_of(p->s, at, g);
        for (size_t a = 0; a < 3; a++) { gradient[3 * i + a] = (float)g[a]; }
    }
    if (!p->s->net || n == 0) { return; }
    dist_field_eval(p->ctx, p->field, n, p->points, p->sdf, gradient);
    check(p->ctx);
    for (size_t i = 0; i < n; i++) { sdf[i] = (double)p->sdf[i]; }
}

/* The rays that meet the bounding sphere, at their entry. */
static size_t rays_of(const dist_field *field, const dist_camera *camera, double origin[3], ray *rays)
{
    size_t count = 0;
    disti_view eye;
    disti_view_of(camera, &eye);
    for (int a = 0; a < 3; a++) { origin[a] = eye.center[a]; }
    for (int i = 0; i < camera->width * camera->height; i++) {
        ray r;
        double x = ((double)(i % camera->width) + eye.first - eye.cx) / eye.fx;
        double y = ((double)(i / camera->width) + eye.first - eye.cy) / eye.fy;
        double length = length_of(x, y, 1);
        double b = 0;
        double c = 0;
        memset(&r, 0, sizeof r);
        for (int a = 0; a < 3; a++) {
            double from = origin[a] - (double)field->center[a];
            r.d[a] = (eye.rotation[a] * x + eye.rotation[3 + a] * y + eye.rotation[6 + a]) / length;
            b += from * r.d[a];
            c += from * from;
        }
        double root = b * b - c + (double)field->radius * (double)field->radius;
        if (root <= 0) { continue; }
        r.t = r.previous = fmax(-b - sqrt(root), 0);
        r.exit = -b + sqrt(root);
        r.f = 1e30;
        r.pixel = (size_t)i;
        rays[count++] = r;
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
        probe(p, n, rays, sdf, NULL);
        for (size_t i = 0; i < n; i++) {
            if (sdf[i] >= 0) {
                rays[i].previous = rays[i].t;
                rays[i].t = rays[i].exit;
            }
        }
    }
}

/* Thirds the interval low..high of each miss that holds its smallest f. */
static void smallest(const prober *p, size_t n, ray *rays, double *sdf, double *other, double *least)
{
    for (int round = 0; round < (p->s->net ? 16 : 40); round++) {
        for (size_t i = 0; i < n; i++) { rays[i].t = (2 * rays[i].low + rays[i].high) / 3; }
        probe(p, n, rays, sdf, NULL);
        for (size_t i = 0; i < n; i++) { rays[i].t = (rays[i].low + 2 * rays[i].high) / 3; }
        probe(p, n, rays, other, NULL);
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
}

/* Marches every ray to its first f < 0; returns how many cross, and sorts hits and misses into their arrays. */
static size_t march(const prober *p, reference *ref, size_t active, ray *rays, ray *hits, ray *misses, double *sdf)
{
    double shortest = p->s->net ? 5e-4 : 1e-5;
    size_t hit_count = 0;
    size_t miss_count = 0;
    for (int round = 0; active; round++) {
        size_t kept = 0;
        probe(p, active, rays, sdf, NULL);
        for (size_t i = 0; i < active; i++) {
            ray r = rays[i];
            double *least = ref->smallest + r.pixel;
            double *dip = ref->dip + r.pixel;
            if (sdf[i] < 0) {
                ref->status[r.pixel] = round == 0 ? REF_INSIDE : sdf[i] < -CLEAR ? REF_HIT : REF_BARELY;
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

static reference reference_create(dist_context *ctx, const scene *s, const dist_field *field, const dist_camera *camera)
{
    reference ref;
    prober p;
    ref.n = (size_t)camera->width * (size_t)camera->height;
    ref.distance = (double *)take(ref.n, sizeof(double));
    ref.smallest = (double *)take(ref.n, sizeof(double));
    ref.dip = (double *)take(ref.n, sizeof(double));
    ref.normal = take_floats(3 * ref.n);
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
    p.gradient = take_floats(3 * ref.n);
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
    probe(&p, hit_count, hits, sdf, p.gradient);
    for (size_t i = 0; i < hit_count; i++) {
        ref.distance[hits[i].pixel] = 0.5 * (hits[i].previous + hits[i].t);
        memcpy(ref.normal + 3 * hits[i].pixel, p.gradient + 3 * i, 3 * sizeof(float));
    }
    free(rays);
    free(hits);
    free(misses);
    free(sdf);
    free(other);
    free(p.points);
    free(p.sdf);
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
    int size, runs;
    double queries, operations, seconds, fastest, slowest, silhouette_queries, silhouette_seconds;
    double mean, p99, largest, normal, silhouette, near, violations, touched;
    size_t hits, holes, false_hits, unresolved, true_hits;
} row;

/* A little more than acos of the dot product can tell apart near 0. */
static double degrees_between(const float *a, const float *b)
{
    double x[3] = {(double)a[0], (double)a[1], (double)a[2]};
    double y[3] = {(double)b[0], (double)b[1], (double)b[2]};
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

/* Renders until there are seven runs or `patience` seconds are over, then once more with the silhouette and once with
   all planes to judge. */
static row picture(dist_context *ctx, const dist_field *field, const dist_camera *camera, const reference *ref,
                   const dist_render_desc *how, double patience)
{
    enum { RUNS = 7 };
    row r;
    dist_stats stats;
    dist_images out;
    double seconds[RUNS];
    double begin = seconds_now();
    memset(&r, 0, sizeof r);
    memset(&out, 0, sizeof out);
    out.distance = take_floats(ref->n);
    out.mask = (unsigned char *)take(ref->n, 1);
    out.stats = &stats;
    size_t runs = 0;
    do {
        double from = seconds_now();
        memset(&stats, 0, sizeof stats);
        dist_render(ctx, field, camera, how, &out, NULL);
        check(ctx);
        seconds[runs++] = seconds_now() - from;
    } while (runs < RUNS && seconds_now() - begin < patience);
    r.runs = (int)runs;
    r.seconds = median(runs, seconds);
    r.fastest = seconds[0];
    r.slowest = seconds[runs - 1];
    r.queries = (double)stats.queries;
    r.operations = stats.operations_done;
    out.silhouette = take_floats(ref->n);
    memset(&stats, 0, sizeof stats);
    double start = seconds_now();
    dist_render(ctx, field, camera, how, &out, NULL);
    check(ctx);
    r.silhouette_seconds = seconds_now() - start;
    r.silhouette_queries = (double)stats.queries;
    out.normal = take_floats(3 * ref->n);
    out.error = take_floats(ref->n);
    out.status = (unsigned char *)take(ref->n, 1);
    memset(&stats, 0, sizeof stats);
    dist_render(ctx, field, camera, how, &out, NULL);
    check(ctx);
    compare(ref, &out, (double)stats.epsilon, &r);
    free(out.distance);
    free(out.mask);
    free(out.normal);
    free(out.silhouette);
    free(out.error);
    free(out.status);
    return r;
}

static void print_row(const row *r)
{
    double pixels = (double)r->size * (double)r->size;
    printf("%s,%s,%s,%.3g,%d,%.0f,%.4f,%.1f,%.5f,%.3e,%.3e,%.3e,%.0f,%.0f,%.4g,%.3e,%.4g,%d,%.5f,%.5f,%.0f,%.0f,%.4g,"
           "%.0f,%.5f,%.3e\n",
           r->s->name, r->m->name, r->parameter, r->value, r->size, r->queries, r->queries / pixels,
           r->operations / pixels, r->seconds, r->mean, r->p99, r->largest, (double)r->holes, (double)r->false_hits,
           r->normal, r->silhouette, r->violations, r->runs, r->fastest, r->slowest, (double)r->hits,
           (double)r->unresolved, r->touched, r->silhouette_queries, r->silhouette_seconds,
           r->near);
    fflush(stdout);
}

/* ---- plots ------------------------------------------------------------------------------------------------------- */

enum { PANEL_WIDTH = 300, PANEL_HEIGHT = 250, ACROSS = 4, DOWN = 2 };

/* A failed picture; a wrong pixel or two of a small one are not. */
static int failed(const row *r)
{
    double wrong = (double)(r->holes + r->false_hits);
    return wrong > fmax(2, 1e-3 * (double)r->true_hits) || (r->m->trace != DIST_TRACE_PAPER && r->violations > 1);
}

static double plot_x(const row *r, int line, int column)
{
    if (line) { return column > 1 ? r->silhouette_seconds : r->seconds; }
    return (column > 1 ? r->silhouette_queries : r->queries) / ((double)r->size * (double)r->size);
}

static double plot_y(const row *r, int column)
{
    double wrong = (double)(r->holes + r->false_hits) / (double)(r->true_hits ? r->true_hits : 1);
    return column == 0 ? r->p99 : column == 1 ? wrong : column == 2 ? r->near : r->silhouette;
}

typedef struct panel {
    FILE *f;
    double left, top, range[4]; /* powers of ten: lowest and highest x, then y; what is lower is drawn at the edge */
} panel;

static double panel_at(const panel *p, double value, int y)
{
    const double *range = p->range + 2 * y;
    double low = pow(10, range[0]);
    double at = (log10(value > low ? value : low) - range[0]) / (range[1] - range[0]);
    return y ? p->top + (1 - at) * (PANEL_HEIGHT - 60) : p->left + at * (PANEL_WIDTH - 70);
}

static panel panel_begin(FILE *f, const row *rows, size_t n, int line, int column)
{
    static const char *const titles[ACROSS] = {"distance, 99 % of the hits", "wrong pixels per pixel to hit",
                                               "silhouette near the outline, mean",
                                               "silhouette at all misses, mean"};
    static const double least[ACROSS] = {1e-8, 1e-5, 1e-8, 1e-8};
    panel p;
    p.f = f;
    p.left = 60 + PANEL_WIDTH * column;
    p.top = 60 + PANEL_HEIGHT * line;
    p.range[0] = p.range[2] = 300;
    p.range[1] = p.range[3] = -300;
    for (size_t i = 0; i < n; i++) {
        double x = log10(fmax(plot_x(rows + i, line, column), 1e-6));
        double y = log10(fmax(plot_y(rows + i, column), least[column]));
        p.range[0] = fmin(p.range[0], floor(x));
        p.range[1] = fmax(p.range[1], ceil(x + 1e-9));
        p.range[2] = fmin(p.range[2], floor(y));
        p.range[3] = fmax(p.range[3], ceil(y + 1e-9));
    }
    double bottom = p.top + PANEL_HEIGHT - 60;
    double right = p.left + PANEL_WIDTH - 70;
    for (double x = p.range[0]; x <= p.range[1]; x++) {
        double at = panel_at(&p, pow(10, x), 0);
        fprintf(f, "<path d='M%.1f %.1fV%.1f' stroke='#ddd'/><text x='%.1f' y='%.1f' text-anchor='middle'>%g</text>\n",
                at, p.top, bottom, at, bottom + 15, pow(10, x));
    }
    for (double y = p.range[2]; y <= p.range[3]; y++) {
        double at = panel_at(&p, pow(10, y), 1);
        fprintf(f, "<path d='M%.1f %.1fH%.1f' stroke='#ddd'/><text x='%.1f' y='%.1f' text-anchor='end'>%s%.0e</text>\n",
                p.left, at, right, p.left - 4, at + 4, y <= log10(least[column]) + 0.5 ? "&lt;" : "", pow(10, y));
    }
    fprintf(f, "<text x='%.1f' y='%.1f' text-anchor='middle'>%s</text>\n", 0.5 * (p.left + right), bottom + 30,
            line ? "seconds" : "queries per pixel");
    fprintf(f, "<text x='%.1f' y='%.1f' text-anchor='middle' font-weight='bold'>%s</text>\n", 0.5 * (p.left + right),
            p.top - 8, titles[column]);
    return p;
}

/* Circle, square or diamond. */
static void plot_marker(FILE *f, const row *r, double x, double y, const char *color)
{
    const char *fill = failed(r) ? "white" : color;
    int alpha = strcmp(r->parameter, "alpha") == 0;
    if (alpha || strcmp(r->parameter, "steps") == 0) {
        fprintf(f, "<rect x='%.1f' y='%.1f' width='5' height='5' fill='%s' stroke='%s'", x - 2.5, y - 2.5, fill, color);
        if (!alpha) { fprintf(f, " transform='rotate(45 %.1f %.1f)'", x, y); }
        fputs("/>\n", f);
        return;
    }
    double radius = strcmp(r->parameter, "default") == 0 ? 4.5 : 2.8;
    fprintf(f, "<circle cx='%.1f' cy='%.1f' r='%.1f' fill='%s' stroke='%s'/>\n", x, y, radius, fill, color);
}

static const char *color_of(size_t k)
{
    static const char *const colors[METHODS] = {"#7f7f7f", "#c98a00", "#d1495b", "#8a5fbf", "#7f7f7f", "#c98a00",
                                                "#d1495b", "#8a5fbf", "#0b3d91", "#3aa0e0", "#17a589", "#2e8b57"};
    return colors[k];
}

static void plot_method(const panel *p, const row *rows, size_t n, int line, int column, size_t k)
{
    const char *dash = methods[k].steps == 100 ? " stroke-dasharray='4 3'" : "";
    fprintf(p->f, "<polyline fill='none' stroke='%s' stroke-width='1.4'%s points='", color_of(k), dash);
    for (size_t i = 0; i < n; i++) {
        if (rows[i].m != &methods[k] || strcmp(rows[i].parameter, "epsilon") != 0) { continue; }
        double x = panel_at(p, plot_x(rows + i, line, column), 0);
        fprintf(p->f, "%.1f,%.1f ", x, panel_at(p, plot_y(rows + i, column), 1));
    }
    fputs("'/>\n", p->f);
    for (size_t i = 0; i < n; i++) {
        if (rows[i].m != &methods[k]) { continue; }
        double x = panel_at(p, plot_x(rows + i, line, column), 0);
        plot_marker(p->f, rows + i, x, panel_at(p, plot_y(rows + i, column), 1), color_of(k));
    }
}

/* All rows of one case and size. */
static void plot(const char *stem, const row *rows, size_t n)
{
    enum { WIDTH = 60 + ACROSS * PANEL_WIDTH + 170, HEIGHT = 60 + DOWN * PANEL_HEIGHT };
    char name[PATH_SIZE];
    char path[PATH_SIZE];
    int length = snprintf(name, sizeof name, "_%s_%d.svg", rows->s->name, rows->size);
    if (length < 0 || (size_t)length >= sizeof name) { fail("the name of the case %s is too long", rows->s->name); }
    FILE *f = open_file(path_of(path, stem, name), "wb");
    fprintf(f, "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 %d %d' width='%d' height='%d' "
            "font-family='sans-serif' font-size='11' fill='#333'>\n<rect width='%d' height='%d' fill='white'/>\n",
            WIDTH, HEIGHT, WIDTH, HEIGHT, WIDTH, HEIGHT);
    fprintf(f, "<text x='%d' y='24' text-anchor='middle' font-size='15'>%s, %d x %d: error against cost</text>\n",
            WIDTH / 2, rows->s->name, rows->size, rows->size);
    for (int line = 0; line < DOWN; line++) {
        for (int column = 0; column < ACROSS; column++) {
            panel p = panel_begin(f, rows, n, line, column);
            for (size_t k = METHODS; k-- > 0;) { plot_method(&p, rows, n, line, column, k); }
        }
    }
    int x = 50 + ACROSS * PANEL_WIDTH;
    for (int k = 0; k < METHODS; k++) {
        const char *dash = methods[k].steps == 100 ? " stroke-dasharray='4 3'" : "";
        fprintf(f, "<path d='M%d %dh22' stroke='%s' stroke-width='2'%s/><text x='%d' y='%d'>%s</text>\n", x,
                76 + 18 * k, color_of((size_t)k), dash, x + 28, 80 + 18 * k, methods[k].name);
    }
    static const char *const notes[] = {"line: epsilon 1e-2 to 1e-7", "large circle: default", "square: alpha",
                                        "diamond: budget of steps", "open: the picture failed"};
    for (int k = 0; k < 5; k++) { fprintf(f, "<text x='%d' y='%d'>%s</text>\n", x, 320 + 18 * k, notes[k]); }
    fputs("</svg>\n", f);
    close_file(f, path);
}

/* ---- the sweep --------------------------------------------------------------------------------------------------- */

static const double epsilons[] = {1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7};
static const double alphas[] = {1.0, 1.2, 1.4, 1.6, 1.8, 1.9};
static const double budgets[] = {10, 20, 30, 50};

typedef struct sweep {
    dist_context *ctx;
    const scene *s;
    const dist_field *field;
    dist_camera camera;
    reference ref;
    int quick;
    const char *svg; /* stem of the plots' names; NULL: none */
    row *rows;
    size_t count;
} sweep;

static void add_row(sweep *w, const method *m, const char *parameter, double value)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.trace = m->trace;
    how.paper_row = m->row;
    how.max_steps = m->steps;
    how.no_cones = m->no_cones;
    how.no_prediction = m->no_prediction;
    how.certified = m->certified;
    how.normal_space = DIST_SPACE_WORLD;
    if (strcmp(parameter, "epsilon") == 0) { how.epsilon = (float)value; }
    if (strcmp(parameter, "alpha") == 0) { how.step_scale = (float)value; }
    if (strcmp(parameter, "steps") == 0) { how.max_steps = (int)value; }
    if (w->count == MOST_ROWS) { fail("more than %d rows", MOST_ROWS); }
    row r = picture(w->ctx, w->field, &w->camera, &w->ref, &how, w->quick ? 0.05 : 2.0);
    r.s = w->s;
    r.m = m;
    r.parameter = parameter;
    r.value = value;
    r.size = w->camera.width;
    print_row(&r);
    w->rows[w->count++] = r;
}

/* One field at one size. The values of a quick sweep are every second of all. */
static void sweep_field(sweep *w, int size)
{
    size_t by = w->quick ? 2 : 1;
    size_t first = w->count;
    w->camera = camera_of(w->s, w->field, size);
    w->ref = reference_create(w->ctx, w->s, w->field, &w->camera);
    for (size_t k = 0; k < METHODS; k++) {
        const method *m = &methods[k];
        add_row(w, m, "default", 0);
        for (size_t i = 0; i < sizeof epsilons / sizeof epsilons[0]; i += by) { add_row(w, m, "epsilon", epsilons[i]); }
        for (size_t i = 0; m->by_alpha && i < sizeof alphas / sizeof alphas[0]; i += by) {
            add_row(w, m, "alpha", alphas[i]);
        }
        for (size_t i = 0; m->by_steps && i < sizeof budgets / sizeof budgets[0]; i += by) {
            add_row(w, m, "steps", budgets[i]);
        }
    }
    reference_destroy(&w->ref);
    if (w->svg) { plot(w->svg, w->rows + first, w->count - first); }
}

static void run_scene(sweep *w, const scene *s, int only_size, int most)
{
    scene copy;
    dist_field field;
    dist_shape *shape = NULL;
    dist_net *net = s->net ? load_net_or_skip(w->ctx, s->net) : NULL;
    if (s->net && !net) { return; }
    if (net) {
        const float *code = dist_net_code(net, s->code);
        if (dist_net_code_size(net) && !code) { fail("%s has no code %d", s->name, s->code); }
        shape = dist_shape_create(w->ctx, net, code);
        check(w->ctx);
        field = dist_shape_field(shape);
    } else {
        field = analytic_field(s, &copy);
    }
    w->s = s;
    w->field = &field;
    for (int size = only_size ? only_size : 64; size <= (only_size ? only_size : most); size *= 2) {
        sweep_field(w, size);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
}

/* ---- where it does badly ----------------------------------------------------------------------------------------- */

/* What a picture is judged by, and what does not matter of it. */
enum { P99, NORMAL, NEAR_SILHOUETTE, SILHOUETTE, HOLES, FALSE_HITS, METRICS };
static const char *const metric_names[METRICS] = {"p99 error", "p99 of the normals' degrees",
                                                  "silhouette error near the outline", "silhouette error", "holes",
                                                  "false hits"};
static const double metric_floors[METRICS] = {CLEAR, 0.01, 1e-5, 1e-4, 0, 0};

static double metric(const row *r, int k)
{
    switch (k) {
    case P99: return r->p99;
    case NORMAL: return r->normal;
    case NEAR_SILHOUETTE: return r->near;
    case SILHOUETTE: return r->silhouette;
    case HOLES: return (double)r->holes;
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
        if (a->violations > 1) {
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

int main(int argc, char **argv)
{
    const char *only = NULL;
    int only_size = 0;
    int slow = 0;
    dist_context_desc settings = {.workers = 1};
    sweep w;
    memset(&w, 0, sizeof w);
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--case")) {
            only = option_text(&o);
        } else if (option_is(&o, "--size")) {
            only_size = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--long")) {
            slow = option_flag(&o);
        } else if (option_is(&o, "--svg")) {
            w.svg = option_text(&o);
        } else if (option_is(&o, "--workers")) {
            settings.workers = option_int(&o, 1, 256);
        } else if (option_is(&o, "--quick")) {
            w.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    w.ctx = dist_context_create(&settings);
    check(w.ctx);
    w.rows = (row *)take(MOST_ROWS, sizeof *w.rows);
    puts("case,method,parameter,value,resolution,queries,queries_per_pixel,operations_per_pixel,seconds,mean_error,"
         "p99_error,max_error,holes,false_hits,normal_p99_degrees,silhouette_mean_error,bound_violations_per_mille,"
         "runs,seconds_min,seconds_max,hits,unresolved,touched_per_mille,queries_with_silhouette,"
         "seconds_with_silhouette,silhouette_near_mean_error");
    for (int i = 0; i < SCENES; i++) {
        const scene *s = &scenes[i];
        int wanted = only ? strcmp(only, s->name) == 0 : w.quick ? s->quick : slow || !s->slow;
        if (wanted) { run_scene(&w, s, only_size, w.quick ? 64 : slow ? 1024 : 512); }
    }
    print_worst(w.rows, w.count);
    free(w.rows);
    dist_context_destroy(w.ctx);
    return 0;
}
