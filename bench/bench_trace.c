/* SPDX-License-Identifier: MIT-0
   bench_trace.c - how many queries a picture takes, and how exact it is, against a reference found by small steps.
   CSV on stdout. The camera is 2.2 radii away (azimuth 35, elevation 25 degrees) with a focal length of 385 pixels at
   512, so that there about 121,000 rays meet the bounding sphere, as in the paper's table of queries. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"

static const char usage[] =
    "bench_trace [options]\n"
    "  --ladder MODEL     the paper's rows and the guarded tracer on one decoder, beside the paper's own counts;\n"
    "                     a file, the word embedded, or sphere, torus or box\n"
    "  --code N           its code (default 0)\n"
    "  --size N           pixels along a side (default 512)\n"
    "  --steps N          of the paper's rows: 50 (default) or 100\n"
    "  --case NAME        without --ladder: only this one\n"
    "  --slow             also the decoders of 8 x 512 and with layer norm\n"
    "  --quick            128 pixels, few cases\n";

typedef struct trace_case {
    const char *name, *net; /* net NULL: analytic, by its name */
    int code, slow, quick;
} trace_case;

static const trace_case cases[] = {
    {"sphere", NULL, 0, 0, 1},
    {"torus", NULL, 0, 0, 1},
    {"box", NULL, 0, 0, 1},
    {"embedded_5", "embedded", 5, 0, 1},
    {"fox", "fox", 0, 0, 1},
    {"bunny_relu", "bunny_relu", 0, 0, 0},
    {"rings", "rings", 0, 0, 0},
    {"two_spheres_sine", "two_spheres_sine", 0, 0, 0},
    {"bob", "bob_spot", 0, 0, 0},
    {"spot", "bob_spot", 1, 0, 1},
    {"spot_geometry", "spot_geometry", 0, 0, 0},
    {"primitives_13", "primitives", 13, 0, 0},
    {"round_cross_10", "round_cross", 10, 0, 0},
    {"mug", "mug_camera_bottle", 0, 0, 0},
    {"chairs_3", "chairs", 3, 1, 0},
    {"spot_512", "deepsdf_512", 0, 1, 0},
};

typedef struct method {
    const char *name;
    int trace, row, no_cones;
    double paper_queries; /* table 1 of the paper, 50 steps, in millions */
} method;

static const method methods[] = {
    {"paper_parallel", DIST_TRACE_PAPER, DIST_PAPER_PARALLEL, 0, 6.06},
    {"paper_dynamic", DIST_TRACE_PAPER, DIST_PAPER_DYNAMIC, 0, 1.99},
    {"paper_aggressive", DIST_TRACE_PAPER, DIST_PAPER_AGGRESSIVE, 0, 1.43},
    {"paper_coarse_to_fine", DIST_TRACE_PAPER, DIST_PAPER_COARSE_TO_FINE, 0, 0.887},
    {"guarded_no_cones", DIST_TRACE_GUARDED, 0, 1, 0},
    {"guarded", DIST_TRACE_GUARDED, 0, 0, 0},
};

enum { CASES = sizeof cases / sizeof cases[0], METHODS = sizeof methods / sizeof methods[0], FIRST_SHORT = 3 };

static const float sphere_numbers[4] = {0, 0, 0, 0.8f};
static const float torus_numbers[5] = {0, 0, 0, 0.62f, 0.24f};
static const float box_numbers[6] = {0, 0, 0, 0.5f, 0.35f, 0.45f};

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

static void eval_rays(dist_context *ctx, const dist_field *field, size_t n, const ray *rays, float *points, float *sdf)
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
static size_t rays_of(const dist_field *field, const dist_camera *camera, ray *rays)
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
static void bisect(dist_context *ctx, const dist_field *field, size_t n, ray *rays, float *points, float *sdf)
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

static reference reference_create(dist_context *ctx, const dist_field *field, const dist_camera *camera)
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
            r.t += fmaxf(sdf[i] / 2.6f, 5e-4f);
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

static void reference_destroy(reference *ref)
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
} result;

/* A false hit is one where the reference stays farther than 5e-5 from the surface; rays that start inside do not
   count. */
static void compare(const reference *ref, const float *distance, const unsigned char *mask, result *r)
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

static result trace_once(dist_context *ctx, const dist_field *field, const dist_camera *camera, const method *m,
                         int steps, const reference *ref)
{
    enum { REPETITIONS = 3 };
    result r;
    double seconds[REPETITIONS];
    size_t count = 0;
    dist_render_desc how;
    dist_images out;
    memset(&r, 0, sizeof r);
    memset(&how, 0, sizeof how);
    memset(&out, 0, sizeof out);
    how.trace = m->trace;
    how.paper_row = m->row;
    how.no_cones = m->no_cones;
    how.max_steps = m->trace == DIST_TRACE_PAPER ? steps : 0;
    out.distance = take_floats(ref->n);
    out.mask = (unsigned char *)take(ref->n, 1);
    out.stats = &r.stats;
    do {
        double start = seconds_now();
        memset(&r.stats, 0, sizeof r.stats);
        dist_render(ctx, field, camera, &how, &out, NULL);
        check(ctx);
        seconds[count++] = seconds_now() - start;
    } while (count < REPETITIONS && seconds[0] < 2.0);
    r.seconds = median(count, seconds);
    compare(ref, out.distance, out.mask, &r);
    free(out.distance);
    free(out.mask);
    return r;
}

static void print_result(const char *name, const method *m, int size, const result *r)
{
    printf("%s,%s,%d,%.2g,%llu,%.4f,%.0f,%.2e,%.2e,%.2e,%.0f,%.0f", name, m->name, size, (double)r->stats.epsilon,
           r->stats.queries, r->seconds, (double)r->hits, r->mean, r->p99, r->largest, (double)r->holes,
           (double)r->false_hits);
}

/* All methods on one field. scaled: queries where the parallel row has the paper's 6.06 million. */
static void ladder(dist_context *ctx, const char *name, const dist_field *field, int size, int steps)
{
    dist_camera camera = bench_camera(field, size, size);
    reference ref = reference_create(ctx, field, &camera);
    double parallel = 0;
    for (int m = 0; m < METHODS; m++) {
        result r = trace_once(ctx, field, &camera, &methods[m], steps, &ref);
        if (m == 0) { parallel = (double)r.stats.queries; }
        print_result(name, &methods[m], size, &r);
        double paper = methods[m].paper_queries; /* with 100 steps the paper gives the last row only */
        if (steps == 100) { paper = methods[m].row == DIST_PAPER_COARSE_TO_FINE && paper > 0 ? 0.898 : 0; }
        printf(",%.0f,", parallel > 0 ? (double)r.stats.queries / parallel * 6.06e6 * (steps / 50.0) : 0);
        if (paper > 0) { printf("%.0f", 1e6 * paper); }
        putchar('\n');
        fflush(stdout);
    }
    reference_destroy(&ref);
}

static dist_field analytic(const char *name)
{
    if (strcmp(name, "torus") == 0) { return dist_field_torus(torus_numbers); }
    if (strcmp(name, "box") == 0) { return dist_field_box(box_numbers); }
    return dist_field_sphere(sphere_numbers);
}

static int is_analytic(const char *name)
{
    return strcmp(name, "sphere") == 0 || strcmp(name, "torus") == 0 || strcmp(name, "box") == 0;
}

/* Analytic shapes get the bounding sphere of a net, so that all cases have the same picture. */
static dist_field field_of(dist_context *ctx, const char *name, const dist_net *net, int code, dist_shape **shape)
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

static void run_case(dist_context *ctx, const trace_case *c, int quick)
{
    dist_net *net = c->net ? load_net_or_skip(ctx, c->net) : NULL;
    if (c->net && !net) { return; }
    dist_shape *shape = NULL;
    dist_field field = field_of(ctx, c->name, net, c->code, &shape);
    for (int size = 128; size <= (quick ? 128 : 512); size *= 2) {
        dist_camera camera = bench_camera(&field, size, size);
        reference ref = reference_create(ctx, &field, &camera);
        for (int m = FIRST_SHORT; m < METHODS; m++) {
            result r = trace_once(ctx, &field, &camera, &methods[m], 50, &ref);
            print_result(c->name, &methods[m], size, &r);
            putchar('\n');
            fflush(stdout);
        }
        reference_destroy(&ref);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
}

int main(int argc, char **argv)
{
    const char *ladder_of = NULL;
    const char *only = NULL;
    int code = 0;
    int size = 512;
    int steps = 50;
    int slow = 0;
    int quick = 0;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--ladder")) {
            ladder_of = option_text(&o);
        } else if (option_is(&o, "--code")) {
            code = option_int(&o, 0, 1 << 30);
        } else if (option_is(&o, "--size")) {
            size = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--steps")) {
            steps = option_int(&o, 1, 1000);
        } else if (option_is(&o, "--case")) {
            only = option_text(&o);
        } else if (option_is(&o, "--slow")) {
            slow = option_flag(&o);
        } else if (option_is(&o, "--quick")) {
            quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    dist_context *ctx = dist_context_create(NULL);
    printf("case,method,resolution,epsilon,queries,seconds,hits,mean_error,p99_error,max_error,holes,false_hits%s\n",
           ladder_of ? ",scaled_queries,paper_queries" : "");
    if (ladder_of) {
        dist_shape *shape = NULL;
        dist_net *net = is_analytic(ladder_of) ? NULL : load_model(ctx, ladder_of);
        dist_field field = field_of(ctx, ladder_of, net, code, &shape);
        ladder(ctx, ladder_of, &field, size, steps);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    for (int i = 0; !ladder_of && i < CASES; i++) {
        const trace_case *c = &cases[i];
        int wanted = only ? strcmp(only, c->name) == 0 : quick ? c->quick : slow || !c->slow;
        if (wanted) { run_case(ctx, c, quick); }
    }
    dist_context_destroy(ctx);
    return 0;
}
