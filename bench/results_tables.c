/* SPDX-License-Identifier: MIT-0
   results_tables.c - the paper's table and figures of the tracer, with our columns beside them: the ladder of
   accelerations (table 1), aggressive marching (steps against the angle, holes in thin shapes), and the threshold. The
   paper's rows are its authors' code's (DIST_TRACE_PAPER). Errors are against a reference found by small steps; the
   camera is bench_camera. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "ladder.h"
#include "plot.h"
#include "results.h"

static const char usage[] =
    "results_tables [options]: ladder, marching, threshold\n" RESULTS_USAGE;

/* ---- the ladder -------------------------------------------------------------------------------------------------- */

enum { LADDER_ROUNDS = 3, LADDER_SIZE = 512, LADDER_QUICK_SIZE = 96 };
#define LADDER_SLOW 5.0 /* seconds; what takes longer is timed once */

typedef struct ladder_case {
    const char *name, *net;
    int code, quick;
} ladder_case;

static const ladder_case ladder_cases[] = {
    {"embedded, a sofa", "embedded", 20, 1},
    {"embedded, a table", "embedded", 132, 0},
    {"8 x 128, a cow", "bob_spot", 1, 0},
    {"8 x 512, a cow (DeepSDF's size)", "deepsdf_512", 0, 0},
};

/* One method at one number of steps: forward is depth and mask; a step of an optimization is depth, silhouette and
   mask with a tape, and the gradient for the code. */
typedef struct rung {
    const method *m;
    int steps;
    double forward[LADDER_ROUNDS], step[LADDER_ROUNDS];
    size_t rounds;
    unsigned long long step_queries;
    result r;
} rung;

typedef struct ladder_planes {
    float *depth, *d_depth, *silhouette, *d_silhouette, *d_code;
    unsigned char *mask;
} ladder_planes;

static void run_step(dist_context *ctx, const dist_field *field, const dist_camera *camera, const ladder_planes *p,
                     rung *g)
{
    dist_render_desc how = method_desc(g->m, g->steps);
    dist_tape *tape = dist_tape_create(ctx, camera, &how);
    dist_stats stats;
    dist_images out, d_out;
    dist_gradients grads;
    memset(&stats, 0, sizeof stats);
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    out.depth = p->depth;
    out.silhouette = p->silhouette;
    out.mask = p->mask;
    out.stats = &stats;
    d_out.depth = p->d_depth;
    d_out.silhouette = p->d_silhouette;
    grads.code = p->d_code;
    double start = seconds_now();
    dist_render(ctx, field, camera, &how, &out, tape);
    dist_render_backward(ctx, tape, &d_out, &grads);
    g->step[g->rounds] = seconds_now() - start;
    g->step_queries = stats.queries;
    check(ctx);
    dist_tape_destroy(tape);
}

/* Rounds over all rows, so that what else the machine does meets them all. */
static void run_rungs(dist_context *ctx, const dist_field *field, const dist_camera *camera, int count, rung *rungs)
{
    reference ref = reference_create(ctx, field, camera);
    ladder_planes p;
    p.depth = take_floats(ref.n);
    p.d_depth = take_floats(ref.n);
    p.silhouette = take_floats(ref.n);
    p.d_silhouette = take_floats(ref.n);
    p.d_code = take_floats((size_t)field->code_size);
    p.mask = (unsigned char *)take(ref.n, 1);
    for (size_t i = 0; i < ref.n; i++) { p.d_depth[i] = p.d_silhouette[i] = 1.0f / (float)ref.n; }
    for (int round = 0; round < LADDER_ROUNDS; round++) {
        for (int k = 0; k < count; k++) {
            rung *g = &rungs[k];
            dist_render_desc how = method_desc(g->m, g->steps);
            if (round && g->forward[0] > LADDER_SLOW) { continue; }
            dist_images out;
            memset(&out, 0, sizeof out);
            out.distance = p.depth;
            out.mask = p.mask;
            out.stats = &g->r.stats;
            memset(&g->r, 0, sizeof g->r);
            double start = seconds_now();
            dist_render(ctx, field, camera, &how, &out, NULL);
            check(ctx);
            g->forward[g->rounds] = seconds_now() - start;
            compare(&ref, p.depth, p.mask, &g->r);
            run_step(ctx, field, camera, &p, g);
            g->rounds++;
        }
    }
    free(p.depth);
    free(p.d_depth);
    free(p.silhouette);
    free(p.d_silhouette);
    free(p.d_code);
    free(p.mask);
    reference_destroy(&ref);
}

static const char *short_error(double value)
{
    static char text[4][32];
    static int next = 0;
    next = (next + 1) % 4;
    snprintf(text[next], sizeof text[next], "%.0e", value);
    return text[next];
}

static void ladder_table(FILE *md, const ladder_case *c, int size, int count, const rung *rungs)
{
    fprintf(md, "%s, %d x %d (%llu rays meet the bounding sphere):\n\n"
            "| | steps | queries | holes | false hits | error p99 | forward, s | and backward, s | "
            "published: queries | published: s |\n|---|---|---|---|---|---|---|---|---|---|\n",
            c->name, size, size, rungs[0].r.stats.rays_in_sphere);
    for (int k = 0; k < count; k++) {
        const rung *g = &rungs[k];
        double queries = published_queries(g->m, g->steps);
        char steps[32], published[2][32] = {"", ""};
        if (g->m->no_cones || (g->m->certified && k < METHODS)) { continue; } /* in the csv */
        snprintf(steps, sizeof steps, "%d", g->steps);
        if (queries > 0) {
            snprintf(published[0], sizeof published[0], "%.3g M", queries);
            snprintf(published[1], sizeof published[1], "%.2f", published_seconds(g->m, g->steps));
        }
        fprintf(md, "| %s | %s | %.3g M | %.0f | %.0f | %s | %.3g | %.3g | %s | %s |\n", g->m->name,
                g->m->certified ? "its own" : steps, 1e-6 * (double)g->r.stats.queries, (double)g->r.holes,
                (double)g->r.false_hits, short_error(g->r.p99), g->forward[0], g->step[0], published[0], published[1]);
    }
    fputc('\n', md);
}

static void ladder_panel(plot *p, const ladder_case *c, int count, const rung *rungs)
{
    plot_panel *a = plot_add_panel(p, c->name, "queries", "depth error, p99", PLOT_LOG_X | PLOT_LOG_Y);
    for (int k = 0; k < count; k++) {
        const rung *g = &rungs[k];
        plot_series *s = plot_series_of(a, g->m->name);
        plot_point *q = plot_add(s, (double)g->r.stats.queries, g->r.p99);
        q->open = 1000 * g->r.holes > g->r.hits;
        q->size = g->steps == 50 ? 0.8 : 1.2;
    }
}

static void run_ladder(const results *r, dist_context *ctx)
{
    static const int budgets[2] = {50, 100};
    enum { COUNT = 2 * METHODS };
    int size = r->quick ? LADDER_QUICK_SIZE : LADDER_SIZE;
    char path[PATH_SIZE];
    plot p = plot_begin("Table 1: queries against error", "small markers: 50 steps; large: 100", 2);
    p.open_means = "more than 1 hole in 1000 hits";
    FILE *csv = results_csv(r, "ladder", "case,method,steps,resolution,rays_in_sphere,queries,queries_with_silhouette,"
                                         "forward_seconds,step_seconds,hits,holes,false_hits,mean_error,p99_error,"
                                         "max_error,operations_done,published_queries,published_seconds");
    FILE *md = results_section(r, "ladder", "Table 1: the ladder of accelerations", "build/results_tables");
    fputs("Published: on the authors' shapes with a decoder of 8 x 512, forward and backward on a GTX 1080 Ti: other "
          "data and another machine, so its columns say what the rows are worth there, not how the two compare. "
          "paper_*: the paper's tracer as its authors' code runs it, here. Forward: depth and mask; and backward: "
          "with the silhouette and the gradient for the code. Error: of the distance. Seconds: median of three, or "
          "one run if that is long.\n\n", md);
    for (size_t i = 0; i < sizeof ladder_cases / sizeof ladder_cases[0]; i++) {
        const ladder_case *c = &ladder_cases[i];
        if (r->quick && !c->quick) { continue; }
        dist_net *net = load_net_or_skip(ctx, c->net);
        if (!net) { continue; }
        dist_shape *shape = NULL;
        dist_field field = field_of(ctx, c->net, net, c->code, &shape);
        dist_camera camera = bench_camera(&field, size, size);
        rung rungs[COUNT];
        memset(rungs, 0, sizeof rungs);
        for (int k = 0; k < COUNT; k++) {
            rungs[k].m = &methods[k % METHODS];
            rungs[k].steps = budgets[k / METHODS];
        }
        run_rungs(ctx, &field, &camera, COUNT, rungs);
        for (int k = 0; k < COUNT; k++) {
            rung *g = &rungs[k];
            g->forward[0] = results_median(g->rounds, g->forward);
            g->step[0] = results_median(g->rounds, g->step);
            fprintf(csv, "\"%s\",%s,%d,%d,%llu,%llu,%llu,%.4f,%.4f,%.0f,%.0f,%.0f,%.3e,%.3e,%.3e,%.0f,%.0f,%.2f\n",
                    c->name, g->m->name, g->steps, size, g->r.stats.rays_in_sphere, g->r.stats.queries,
                    g->step_queries, g->forward[0], g->step[0], (double)g->r.hits, (double)g->r.holes,
                    (double)g->r.false_hits, g->r.mean, g->r.p99, g->r.largest, g->r.stats.operations_done,
                    1e6 * published_queries(g->m, g->steps), published_seconds(g->m, g->steps));
            fflush(csv);
        }
        ladder_table(md, c, size, COUNT, rungs);
        ladder_panel(&p, c, COUNT, rungs);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    fputs("![queries against error](ladder.svg)\n", md);
    results_close(r, csv, "ladder", ".csv");
    results_close(r, md, "ladder", ".md");
    plot_write(&p, path_of(path, results_stem(r, "ladder"), ".svg"), results_machine());
    puts(path);
}

/* ---- aggressive marching ----------------------------------------------------------------------------------------- */

#define MARCH_EPSILON 5e-5f

/* A half-space whose border the z axis meets at z = -9, at that angle. */
static void half_space(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const double angle = *(const double *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        sdf[i] = (float)(cos(angle) * (double)p[0] - sin(angle) * ((double)p[2] + 9.0));
        if (!gradient) { continue; }
        gradient[3 * i] = (float)cos(angle);
        gradient[3 * i + 1] = 0.0f;
        gradient[3 * i + 2] = (float)-sin(angle);
    }
}

/* One ray that enters the bounding sphere at a distance of 1 from the border. The radius is 10, so that the clamp of
   the authors' steps, a tenth of it, does nothing. */
static unsigned long long march_once(dist_context *ctx, double angle, int trace, double alpha, double *error)
{
    const float eye[3] = {0, 0, -15}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(1, 1, 0.5f, eye, at, up);
    dist_field field;
    dist_render_desc how;
    dist_images out;
    dist_stats stats;
    float distance = 0;
    memset(&field, 0, sizeof field);
    memset(&how, 0, sizeof how);
    memset(&out, 0, sizeof out);
    memset(&stats, 0, sizeof stats);
    field.user = &angle;
    field.eval_fn = half_space;
    field.radius = 10;
    field.lipschitz = 1;
    how.trace = trace;
    how.paper_row = DIST_PAPER_AGGRESSIVE;
    how.step_scale = (float)alpha;
    how.epsilon = MARCH_EPSILON;
    how.max_steps = 1000;
    how.no_cones = 1; /* they are for pictures: here is one ray */
    out.distance = &distance;
    out.stats = &stats;
    dist_render(ctx, &field, &camera, &how, &out, NULL);
    check(ctx);
    *error = fabs((double)distance - 6.0);
    return stats.queries;
}

/* Bars of a round section, side by side. */
static void bars(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const float radius = *(const float *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        float least = 1e30f;
        for (int k = 0; k < 5; k++) {
            float x = p[0] - 0.25f * (float)(k - 2);
            float y = p[1] - fmaxf(-0.6f, fminf(0.6f, p[1]));
            float z = p[2] - 0.1f * (float)(k % 2);
            float far = sqrtf(x * x + y * y + z * z);
            if (far >= least) { continue; }
            least = far;
            if (gradient) {
                gradient[3 * i] = x / fmaxf(far, 1e-20f);
                gradient[3 * i + 1] = y / fmaxf(far, 1e-20f);
                gradient[3 * i + 2] = z / fmaxf(far, 1e-20f);
            }
        }
        sdf[i] = least - radius;
    }
}

enum { ALPHAS = 10, THIN = 5 };

static double alpha_of(int k)
{
    return 1.0 + 0.1 * k;
}

static void march_angles(const results *r, dist_context *ctx, FILE *md, plot *p)
{
    static const double degrees[] = {2, 5, 10, 20, 30, 45, 60, 90};
    static const char *const names[] = {"alpha 1.0", "alpha 1.5", "alpha 1.9", "dist.h"};
    FILE *csv = results_csv(r, "marching", "degrees,alpha,formula_steps,paper_queries,paper_error,dist_queries,"
                                           "dist_error");
    plot_panel *a = plot_add_panel(p, "steps against the angle", "degrees", "queries", PLOT_LOG_X | PLOT_LOG_Y);
    fputs("A ray that meets a plane at an angle, from a distance of 1, until |f| < 5e-5. Formula: the paper's least "
          "number of steps, log(epsilon / d) / log|1 - alpha sin(angle)|; it gives 52 and 33 at 10 degrees. Counted: "
          "queries of the paper's tracer, which needs fewer where f, the sine of the angle times the distance, is "
          "below epsilon first; and of ours, which brackets the crossing and stops in the error of the distance.\n\n"
          "| degrees | alpha 1: formula | counted | alpha 1.5: formula | counted | alpha 1.9: formula | counted | "
          "dist.h |\n|---|---|---|---|---|---|---|---|\n", md);
    for (size_t i = 0; i < sizeof degrees / sizeof degrees[0]; i++) {
        double angle = degrees[i] * 3.14159265358979323846 / 180.0;
        unsigned long long ours = 0;
        fprintf(md, "| %g |", degrees[i]);
        for (int k = 0; k < ALPHAS; k++) {
            double alpha = alpha_of(k);
            double error[2], rest = fabs(1 - alpha * sin(angle));
            double least = rest > 1e-9 ? ceil(log(5e-5) / log(rest)) : 1;
            unsigned long long paper = march_once(ctx, angle, DIST_TRACE_PAPER, alpha, &error[0]);
            unsigned long long guarded = march_once(ctx, angle, DIST_TRACE_GUARDED, alpha, &error[1]);
            fprintf(csv, "%g,%.1f,%.0f,%llu,%.2e,%llu,%.2e\n", degrees[i], alpha, least, paper, error[0], guarded,
                    error[1]);
            if (k == 5) { ours = guarded; }
            if (k != 0 && k != 5 && k != 9) { continue; }
            fprintf(md, " %.0f | %llu |", least, paper);
            plot_add(plot_series_of(a, names[k == 0 ? 0 : k == 5 ? 1 : 2]), degrees[i], (double)paper);
        }
        plot_add(plot_series_of(a, names[3]), degrees[i], (double)ours);
        fprintf(md, " %llu |\n", ours);
    }
    results_close(r, csv, "marching", ".csv");
}

static void march_holes(const results *r, dist_context *ctx, FILE *md, plot *p)
{
    static const float plates[2][6] = {{0, 0, 0, 0.6f, 0.005f, 0.5f}, {0, 0, 0, 0.6f, 0.0005f, 0.5f}};
    static const float radii[2] = {0.01f, 0.002f};
    static const char *const names[THIN] = {"plate, 0.01 thick", "plate, 0.001 thick", "bars, 0.02 thick",
                                            "bars, 0.004 thick", "embedded, a table"};
    int size = r->quick ? 64 : 256;
    FILE *csv = results_csv(r, "marching_holes", "shape,alpha,tracer,resolution,hits,holes,false_hits,p99_error,"
                                                 "queries");
    dist_net *net = load_model(ctx, "embedded");
    dist_shape *shape = NULL;
    fprintf(md, "\nHoles, in percent of the pixels that should be hit, paper / dist.h; %d x %d pixels, each about %.3f "
                "wide there; 100 steps:\n\n| alpha |", size, size, 2.2 * 512.0 / 385.0 / size);
    for (int s = 0; s < THIN; s++) { fprintf(md, " %s |", names[s]); }
    fputs("\n|---|---|---|---|---|---|\n", md);
    double holes[THIN][ALPHAS][2];
    for (int s = 0; s < THIN; s++) {
        dist_field field;
        memset(&field, 0, sizeof field);
        float radius = radii[s % 2];
        if (s < 2) {
            field = dist_field_box(plates[s]);
        } else if (s < 4) {
            field.user = &radius;
            field.eval_fn = bars;
            field.lipschitz = 1;
        } else {
            field = field_of(ctx, "embedded", net, 132, &shape);
        }
        if (s < 4) { field.radius = 1; }
        dist_camera camera = bench_camera(&field, size, size);
        reference ref = reference_create(ctx, &field, &camera);
        double should = 0;
        for (size_t i = 0; i < ref.n; i++) { should += ref.status[i] == REF_HIT; }
        plot_panel *a = plot_add_panel(p, names[s], "alpha", "holes, % of the hits", PLOT_ZERO_Y);
        for (int k = 0; k < ALPHAS; k++) {
            for (int ours = 0; ours < 2; ours++) {
                dist_render_desc how;
                memset(&how, 0, sizeof how);
                how.trace = ours ? DIST_TRACE_GUARDED : DIST_TRACE_PAPER;
                how.paper_row = DIST_PAPER_AGGRESSIVE;
                how.step_scale = (float)alpha_of(k);
                how.max_steps = 100;
                result t = trace_once(ctx, &field, &camera, &how, &ref);
                holes[s][k][ours] = 100.0 * (double)t.holes / should;
                fprintf(csv, "\"%s\",%.1f,%s,%d,%.0f,%.0f,%.0f,%.2e,%llu\n", names[s], alpha_of(k),
                        ours ? "dist.h" : "paper", size, should, (double)t.holes, (double)t.false_hits, t.p99,
                        t.stats.queries);
                plot_add(plot_series_of(a, ours ? "dist.h" : "paper's tracer"), alpha_of(k), holes[s][k][ours]);
            }
        }
        reference_destroy(&ref);
    }
    for (int k = 0; k < ALPHAS; k++) {
        fprintf(md, "| %.1f |", alpha_of(k));
        for (int s = 0; s < THIN; s++) { fprintf(md, " %.2f / %.2f |", holes[s][k][0], holes[s][k][1]); }
        fputc('\n', md);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    results_close(r, csv, "marching_holes", ".csv");
}

static void run_marching(const results *r, dist_context *ctx)
{
    char path[PATH_SIZE];
    plot p = plot_begin("Aggressive marching", "steps that are alpha times the distance", 3);
    FILE *md = results_section(r, "marching", "Aggressive marching", "build/results_tables");
    march_angles(r, ctx, md, &p);
    march_holes(r, ctx, md, &p);
    fputs("\n[marching_holes.csv](marching_holes.csv)\n\n![aggressive marching](marching.svg)\n", md);
    results_close(r, md, "marching", ".md");
    plot_write(&p, path_of(path, results_stem(r, "marching"), ".svg"), results_machine());
    puts(path);
}

/* ---- the threshold ----------------------------------------------------------------------------------------------- */

enum { THRESHOLDS = 5 };

static void run_threshold(const results *r, dist_context *ctx)
{
    static const double epsilons[THRESHOLDS] = {5e-2, 5e-4, 5e-5, 5e-6, 5e-8};
    static const char *const tracers[2] = {"paper", "dist.h"};
    char path[PATH_SIZE], captions[2 * THRESHOLDS][48];
    const char *lines[2 * THRESHOLDS];
    canvas pictures[2 * THRESHOLDS];
    int size = r->quick ? 64 : 256;
    dist_net *net = load_model(ctx, "embedded");
    dist_shape *shape = NULL;
    dist_field field = field_of(ctx, "embedded", net, 132, &shape);
    dist_camera camera = bench_camera(&field, size, size);
    reference ref = reference_create(ctx, &field, &camera);
    size_t should = 0;
    for (size_t i = 0; i < ref.n; i++) { should += ref.status[i] == REF_HIT; }
    plot p = plot_begin("The threshold", "embedded, a table; 50 steps", 2);
    plot_panel *panels[2];
    plot_add_panel(&p, "dilation", "epsilon", "pixels, % of the shape's", PLOT_LOG_X | PLOT_ZERO_Y);
    plot_add_panel(&p, "erosion", "epsilon", "pixels, % of the shape's", PLOT_LOG_X | PLOT_ZERO_Y);
    panels[0] = &p.panels[0];
    panels[1] = &p.panels[1];
    FILE *csv = results_csv(r, "threshold", "tracer,epsilon,resolution,pixels,dilation,erosion,mean_error,p99_error,"
                                            "unresolved,queries");
    FILE *md = results_section(r, "threshold", "The threshold", "build/results_tables");
    fprintf(md, "Embedded, a table, %d x %d, 50 steps; the shape has %.0f pixels. Dilation: pixels beside the shape "
                "that are hit; erosion: pixels of the shape that are not. The paper shows pictures without numbers.\n\n"
                "| epsilon | paper: dilation | erosion | error p99 | queries | dist.h: dilation | erosion | "
                "error p99 | queries |\n|---|---|---|---|---|---|---|---|---|\n", size, size, (double)should);
    float *normal = take_floats(3 * ref.n);
    float *distance = take_floats(ref.n);
    unsigned char *mask = (unsigned char *)take(ref.n, 1);
    for (int k = 0; k < THRESHOLDS; k++) {
        fprintf(md, "| %.0e |", epsilons[k]);
        for (int ours = 0; ours < 2; ours++) {
            dist_render_desc how;
            dist_images out;
            result t;
            size_t dilation = 0, erosion = 0;
            memset(&how, 0, sizeof how);
            memset(&out, 0, sizeof out);
            memset(&t, 0, sizeof t);
            how.trace = ours ? DIST_TRACE_GUARDED : DIST_TRACE_PAPER;
            how.paper_row = DIST_PAPER_AGGRESSIVE;
            how.max_steps = 50;
            how.epsilon = (float)epsilons[k];
            out.distance = distance;
            out.mask = mask;
            out.stats = &t.stats;
            dist_render(ctx, &field, &camera, &how, &out, NULL);
            compare(&ref, distance, mask, &t);
            unsigned long long queries = t.stats.queries;
            unsigned long long unresolved = t.stats.unresolved;
            out.distance = NULL;
            out.normal = normal;
            dist_render(ctx, &field, &camera, &how, &out, NULL);
            check(ctx);
            for (size_t i = 0; i < ref.n; i++) {
                dilation += mask[i] && (ref.status[i] == REF_MISS || ref.status[i] == REF_OUTSIDE);
                erosion += !mask[i] && ref.status[i] == REF_HIT;
            }
            fprintf(csv, "%s,%.0e,%d,%.0f,%.0f,%.0f,%.2e,%.2e,%llu,%llu\n", tracers[ours], epsilons[k], size,
                    (double)should, (double)dilation, (double)erosion, t.mean, t.p99, unresolved, queries);
            fprintf(md, " %.0f | %.0f | %s | %.3g M |", (double)dilation, (double)erosion, short_error(t.p99),
                    1e-6 * (double)queries);
            plot_add(plot_series_of(panels[0], tracers[ours]), epsilons[k], 100.0 * (double)dilation / (double)should);
            plot_add(plot_series_of(panels[1], tracers[ours]), epsilons[k], 100.0 * (double)erosion / (double)should);
            int at = ours * THRESHOLDS + k;
            pictures[at] = picture_shaded(size, size, normal, mask, NULL);
            snprintf(captions[at], sizeof captions[at], "%s %.0e", tracers[ours], epsilons[k]);
            lines[at] = captions[at];
        }
        fputc('\n', md);
    }
    fprintf(md, "\n![pictures](threshold.%s)\n\n![dilation and erosion](threshold.svg)\n",
#ifdef COMMON_STB
            "png"
#else
            "ppm"
#endif
    );
    results_close(r, csv, "threshold", ".csv");
    results_close(r, md, "threshold", ".md");
    plot_write(&p, path_of(path, results_stem(r, "threshold"), ".svg"), results_machine());
    puts(path);
    canvas sheet = picture_sheet(2 * THRESHOLDS, pictures, lines, THRESHOLDS);
    puts(write_canvas(results_stem(r, "threshold"), &sheet));
    for (int i = 0; i < 2 * THRESHOLDS; i++) { canvas_destroy(&pictures[i]); }
    free(normal);
    free(distance);
    free(mask);
    reference_destroy(&ref);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
}

int main(int argc, char **argv)
{
    results r = results_options(argc, argv, usage);
    dist_context *ctx = dist_context_create(NULL);
    int done = 0;
    if (results_wanted(&r, "ladder")) { run_ladder(&r, ctx), done = 1; }
    if (results_wanted(&r, "marching")) { run_marching(&r, ctx), done = 1; }
    if (results_wanted(&r, "threshold")) { run_threshold(&r, ctx), done = 1; }
    if (!done) { fail("--only takes ladder, marching or threshold"); }
    dist_context_destroy(ctx);
    return 0;
}
