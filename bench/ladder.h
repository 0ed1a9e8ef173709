/* SPDX-License-Identifier: MIT-0
   ladder.h - the rows of the paper's table of queries and ours, one timed picture of each, and what it is off by,
   against a reference found by small steps. Include it after bench.h. */
#ifndef DIST_BENCH_LADDER_H
#define DIST_BENCH_LADDER_H

/* Published: table 1 of the paper, 50 steps, on its own shapes; millions of queries; seconds of forward and backward on
   a GTX 1080 Ti. With 100 steps it has the last row only: 0.898 and 1.24. */
typedef struct method {
    const char *name;
    int trace, row, no_cones, certified;
    double paper_queries, paper_seconds;
} method;

static const method methods[] = {
    {"paper_parallel", DIST_TRACE_PAPER, DIST_PAPER_PARALLEL, 0, 0, 6.06, 3.39},
    {"paper_dynamic", DIST_TRACE_PAPER, DIST_PAPER_DYNAMIC, 0, 0, 1.99, 1.23},
    {"paper_aggressive", DIST_TRACE_PAPER, DIST_PAPER_AGGRESSIVE, 0, 0, 1.43, 1.08},
    {"paper_coarse_to_fine", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 0, 0, 0.887, 0.99},
    {"guarded_no_cones", DIST_TRACE_GUARDED, 0, 1, 0, 0, 0},
    {"guarded", DIST_TRACE_GUARDED, 0, 0, 0, 0, 0},
    {"certified", DIST_TRACE_GUARDED, 0, 0, 1, 0, 0},
};

enum { METHODS = sizeof methods / sizeof methods[0] };

/* steps: of the paper's rows and of the guarded tracer, 0: the default; the certified one has its own. */
static inline dist_render_desc method_desc(const method *m, int steps)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.trace = m->trace;
    how.paper_row = m->row;
    how.no_cones = m->no_cones;
    how.certified = m->certified;
    how.max_steps = m->certified ? 0 : steps;
    return how;
}

static inline double published_queries(const method *m, int steps)
{
    int last = m->row == DIST_PAPER_COARSE_TO_FINE && m->paper_queries > 0;
    return steps == 50 ? m->paper_queries : steps == 100 && last ? 0.898 : 0;
}

static inline double published_seconds(const method *m, int steps)
{
    int last = m->row == DIST_PAPER_COARSE_TO_FINE && m->paper_queries > 0;
    return steps == 50 ? m->paper_seconds : steps == 100 && last ? 1.24 : 0;
}

/* ---- fields ------------------------------------------------------------------------------------------------------ */

static const float sphere_numbers[4] = {0, 0, 0, 0.8f};
static const float torus_numbers[5] = {0, 0, 0, 0.62f, 0.24f};
static const float box_numbers[6] = {0, 0, 0, 0.5f, 0.35f, 0.45f};

static inline dist_field analytic(const char *name)
{
    if (strcmp(name, "torus") == 0) { return dist_field_torus(torus_numbers); }
    if (strcmp(name, "box") == 0) { return dist_field_box(box_numbers); }
    return dist_field_sphere(sphere_numbers);
}

static inline int is_analytic(const char *name)
{
    return strcmp(name, "sphere") == 0 || strcmp(name, "torus") == 0 || strcmp(name, "box") == 0;
}

/* Analytic shapes get the bounding sphere of a net, so that all cases have the same picture. */
static inline dist_field field_of(dist_context *ctx, const char *name, const dist_net *net, int code,
                                  dist_shape **shape)
{
    dist_field field;
    *shape = NULL;
    if (!net) {
        field = analytic(name);
        field.radius = 1.0f;
        return field;
    }
    const float *numbers = dist_net_code(net, code);
    if (dist_net_code_size(net) && !numbers) { fail("%s has no code %d", name, code); }
    *shape = dist_shape_create(ctx, net, numbers);
    field = dist_shape_field(*shape);
    check(ctx);
    return field;
}

/* ---- reference --------------------------------------------------------------------------------------------------- */

enum { REF_OUTSIDE = 0, REF_MISS, REF_HIT, REF_INSIDE };

typedef struct reference {
    size_t n;
    float *distance, *smallest; /* smallest f that a ray which misses has met */
    unsigned char *status;
} reference;

typedef struct ray {
    float origin[3], direction[3], t, previous, exit;
    size_t pixel;
} ray;

static inline void eval_rays(dist_context *ctx, const dist_field *field, size_t n, const ray *rays, float *points,
                             float *sdf)
{
    for (size_t i = 0; i < n; i++) {
        for (int a = 0; a < 3; a++) {
            points[3 * i + (size_t)a] = rays[i].origin[a] + rays[i].t * rays[i].direction[a];
        }
    }
    if (n) { dist_field_eval(ctx, field, n, points, sdf, NULL); }
    check(ctx);
}

/* The rays that meet the bounding sphere, at their entry. */
static inline size_t rays_of(const dist_field *field, const dist_camera *camera, ray *rays)
{
    size_t count = 0;
    for (int i = 0; i < camera->width * camera->height; i++) {
        ray r;
        double b = 0;
        double c = 0;
        dist_camera_ray(camera, (float)(i % camera->width), (float)(i / camera->width), r.origin, r.direction);
        for (int a = 0; a < 3; a++) {
            double d = (double)r.origin[a] - (double)field->center[a];
            b += d * (double)r.direction[a];
            c += d * d;
        }
        double root = b * b - c + (double)field->radius * (double)field->radius;
        if (root <= 0) { continue; }
        r.t = r.previous = (float)(-b - sqrt(root));
        r.exit = (float)(-b + sqrt(root));
        r.pixel = (size_t)i;
        rays[count++] = r;
    }
    return count;
}

/* Halves the bracket previous..t of each hit until single precision is at its end. */
static inline void bisect(dist_context *ctx, const dist_field *field, size_t n, ray *rays, float *points,
                          float *sdf)
{
    for (int round = 0; round < 24; round++) {
        for (size_t i = 0; i < n; i++) {
            rays[i].exit = rays[i].t; /* the inner end; its first meaning is not needed any more */
            rays[i].t = 0.5f * (rays[i].previous + rays[i].t);
        }
        eval_rays(ctx, field, n, rays, points, sdf);
        for (size_t i = 0; i < n; i++) {
            if (sdf[i] >= 0.0f) {
                rays[i].previous = rays[i].t;
                rays[i].t = rays[i].exit;
            }
        }
    }
}

static inline reference reference_create(dist_context *ctx, const dist_field *field, const dist_camera *camera)
{
    reference ref;
    ref.n = (size_t)camera->width * (size_t)camera->height;
    ref.distance = take_floats(ref.n);
    ref.smallest = take_floats(ref.n);
    ref.status = (unsigned char *)take(ref.n, 1);
    ray *rays = (ray *)take(ref.n, sizeof *rays);
    ray *hits = (ray *)take(ref.n, sizeof *hits);
    float *points = take_floats(3 * ref.n);
    float *sdf = take_floats(ref.n);
    size_t hit_count = 0;
    size_t active = rays_of(field, camera, rays);
    for (size_t i = 0; i < active; i++) {
        ref.status[rays[i].pixel] = REF_MISS;
        ref.smallest[rays[i].pixel] = 1e9f;
    }
    for (int round = 0; active; round++) {
        size_t kept = 0;
        eval_rays(ctx, field, active, rays, points, sdf);
        for (size_t i = 0; i < active; i++) {
            ray r = rays[i];
            if (sdf[i] < 0.0f) {
                ref.status[r.pixel] = round == 0 ? REF_INSIDE : REF_HIT;
                if (round) { hits[hit_count++] = r; }
                continue;
            }
            if (sdf[i] < ref.smallest[r.pixel]) { ref.smallest[r.pixel] = sdf[i]; }
            r.previous = r.t;
            r.t += fmaxf(sdf[i] / 2.6f, 5e-5f);
            if (r.t < r.exit) { rays[kept++] = r; }
        }
        active = kept;
    }
    bisect(ctx, field, hit_count, hits, points, sdf);
    for (size_t i = 0; i < hit_count; i++) {
        ref.distance[hits[i].pixel] = 0.5f * (hits[i].previous + hits[i].t);
    }
    free(rays);
    free(hits);
    free(points);
    free(sdf);
    return ref;
}

static inline void reference_destroy(reference *ref)
{
    free(ref->distance);
    free(ref->smallest);
    free(ref->status);
}

/* ---- one picture ------------------------------------------------------------------------------------------------- */

typedef struct result {
    dist_stats stats;
    double seconds, mean, p99, largest;
    size_t hits, holes, false_hits;
    unsigned long long silhouette_queries; /* more with a silhouette */
} result;

/* A false hit is one where the reference stays farther than 5e-5 from the surface; rays that start inside do not
   count. */
static inline void compare(const reference *ref, const float *distance, const unsigned char *mask, result *r)
{
    double *errors = (double *)take(ref->n, sizeof *errors);
    size_t n = 0;
    for (size_t i = 0; i < ref->n; i++) {
        if (ref->status[i] == REF_INSIDE) { continue; }
        r->hits += mask[i] != 0;
        r->holes += ref->status[i] == REF_HIT && !mask[i];
        int clear = ref->status[i] == REF_OUTSIDE || (ref->status[i] == REF_MISS && ref->smallest[i] > 5e-5f);
        r->false_hits += mask[i] && clear;
        if (ref->status[i] != REF_HIT || !mask[i]) { continue; }
        errors[n] = fabs((double)distance[i] - (double)ref->distance[i]);
        r->mean += errors[n++];
    }
    r->mean /= n ? (double)n : 1.0;
    r->p99 = quantile(n, errors, 0.99);
    r->largest = n ? errors[n - 1] : 0;
    free(errors);
}

/* Median of three renders, or the only one if it takes more than two seconds. */
static inline result trace_once(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                const dist_render_desc *how, const reference *ref)
{
    enum { REPETITIONS = 3 };
    result r;
    double seconds[REPETITIONS];
    size_t count = 0;
    dist_images out;
    memset(&r, 0, sizeof r);
    memset(&out, 0, sizeof out);
    out.distance = take_floats(ref->n);
    out.mask = (unsigned char *)take(ref->n, 1);
    out.stats = &r.stats;
    do {
        double start = seconds_now();
        memset(&r.stats, 0, sizeof r.stats);
        dist_render(ctx, field, camera, how, &out, NULL);
        check(ctx);
        seconds[count++] = seconds_now() - start;
    } while (count < REPETITIONS && seconds[0] < 2.0);
    r.seconds = median(count, seconds);
    compare(ref, out.distance, out.mask, &r);
    dist_stats more;
    memset(&more, 0, sizeof more);
    out.stats = &more;
    out.silhouette = take_floats(ref->n);
    dist_render(ctx, field, camera, how, &out, NULL);
    check(ctx);
    r.silhouette_queries = more.queries - r.stats.queries;
    free(out.distance);
    free(out.mask);
    free(out.silhouette);
    return r;
}

#endif
