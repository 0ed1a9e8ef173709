/* SPDX-License-Identifier: MIT-0
   results_pose.c - a known shape and one depth image, the camera looked for, from more and more far away: error against
   iteration, and how many are found. The paper shows one aeroplane in a figure, without a number. The fits are those of
   examples/fit_pose.c on shapes of the embedded decoder: Adam alone, by the paper's tracer and gradient or by ours;
   then with the steps of Gauss and Newton after it; and that with new tries where the picture is not explained. */
#define main fit_pose_main
int fit_pose_main(int argc, char **argv);
#include "../examples/fit_pose.c"
#undef main
#include "plot.h"
#include "results.h"

static const char results_usage[] =
    "results_pose [options]: pose\n" RESULTS_USAGE;

enum { WAY_PAPER, WAY_ADAM, WAY_NEWTON, WAY_RESTARTS, WAYS, MOST_JOBS = 512, MOST_STEPS = 128 };
static const char *const way_names[WAYS] = {"paper, Adam", "dist.h, Adam", "and Gauss-Newton", "and new tries"};

/* Ends of one way: how far off, and whether the picture is the one that was seen. */
typedef struct ending {
    double degrees, distance;
    int found, explained;
    unsigned long long queries;
} ending;

/* One start. */
typedef struct job {
    int trial, index;      /* index: the shape */
    float degrees, distance;
    ending end[WAYS];
    double way[2][MOST_STEPS]; /* degrees off before each step, by the paper's and by ours with Gauss and Newton */
} job;

static ending ending_of(fit *f, const record *r)
{
    ending e;
    score s;
    f->camera = r->camera;
    fit_loss(f, &f->levels[1], 0, NULL);
    e.explained = is_explained(f, &s);
    e.found = is_good(r);
    e.degrees = r->degrees;
    e.distance = r->distance;
    e.queries = f->total.queries;
    return e;
}

static void keep_way(const record *records, int count, int steps, double *way)
{
    for (int i = 0; i <= steps; i++) { way[i] = records[i < count ? i : count - 1].degrees; }
}

static void run_job(const dist_net *net, const request *base, job *j)
{
    request r = *base;
    dist_context *ctx = dist_context_create(&r.fit.settings);
    const float *code = dist_net_code(net, j->index);
    dist_camera camera = view_camera(&r.fit.view, 0.0f);
    dist_shape *truth = dist_shape_create(ctx, net, code);
    dist_field field = dist_shape_field(truth);
    observation seen = observe_field(ctx, &field, &camera);
    observation_keep(&seen, 100.0, 0, 1);
    int steps = r.fit.iterations + r.refine;
    record *records = take_records(&r);
    for (int ours = 0; ours < 2; ours++) {
        rng random = rng_begin(100u + (unsigned)j->trial); /* the same directions for every offset */
        if (!ours) {
            r.fit.how.trace = DIST_TRACE_PAPER;
            r.fit.how.gradient = DIST_GRADIENT_PAPER;
            r.refine = 0;
        } else {
            r.fit.how = base->fit.how;
            r.refine = base->refine;
        }
        fit f = fit_create(ctx, net, &r, code, &camera, &seen);
        camera_off(&f.camera, (double)j->degrees, (double)j->distance, &random);
        dist_camera start = f.camera;
        int count = fit_once(&f, records);
        keep_way(records, count, steps, j->way[ours]);
        record last = records[count - 1];
        j->end[ours ? WAY_ADAM : WAY_PAPER] = ending_of(&f, &records[r.fit.iterations]);
        if (ours) {
            j->end[WAY_NEWTON] = j->end[WAY_RESTARTS] = ending_of(&f, &last);
            if (!j->end[WAY_NEWTON].explained) {
                f.camera = start;
                last = records[fit_run(&f, records) - 1];
                j->end[WAY_RESTARTS] = ending_of(&f, &last);
            }
        }
        fit_destroy(&f);
    }
    free(records);
    observation_destroy(&seen);
    dist_shape_destroy(truth);
    dist_context_destroy(ctx);
}

/* Starts beside each other, one thread each. */
static void run_jobs(const dist_net *net, const request *base, int count, job *jobs)
{
#ifdef _OPENMP
#pragma omp parallel for schedule(dynamic, 1)
#endif
    for (int i = 0; i < count; i++) { run_job(net, base, &jobs[i]); }
}

typedef struct summary {
    int count, found, explained;
    double degrees, distance, queries; /* medians; queries: mean */
} summary;

static summary summary_of(int count, const job *jobs, float degrees, int way)
{
    double off[MOST_JOBS], moved[MOST_JOBS];
    summary s;
    memset(&s, 0, sizeof s);
    for (int i = 0; i < count; i++) {
        const ending *e = &jobs[i].end[way];
        if (fabsf(jobs[i].degrees - degrees) > 1e-6f) { continue; }
        off[s.count] = e->degrees;
        moved[s.count++] = e->distance;
        s.found += e->found;
        s.explained += e->found || e->explained;
        s.queries += (double)e->queries;
    }
    s.degrees = results_median((size_t)s.count, off);
    s.distance = results_median((size_t)s.count, moved);
    s.queries /= s.count ? s.count : 1;
    return s;
}

/* Error over the steps, median and quarters of the starts that are `degrees` off; the share found over the offset. */
static void write_ways(const results *r, int count, const job *jobs, int levels, const float *starts, float degrees,
                       int steps)
{
    static const char *const names[2] = {"paper, Adam", "and Gauss-Newton"};
    double values[MOST_JOBS];
    char path[PATH_SIZE], title[64];
    plot p = plot_begin("Cameras from one depth image", "shapes of the embedded decoder", 2);
    FILE *csv = results_csv(r, "pose_curve", "method,degrees_start,step,degrees_quarter,degrees_median,"
                                             "degrees_three_quarters");
    snprintf(title, sizeof title, "starts %g degrees off", (double)degrees);
    plot_panel *a = plot_add_panel(&p, title, "step", "degrees off, median", PLOT_LOG_Y);
    a->least[1] = 1e-6;
    for (int m = 0; m < 2; m++) {
        plot_series *s = plot_add_series(a, names[m]);
        for (int i = 0; i <= steps; i++) {
            size_t n = 0;
            for (int k = 0; k < count; k++) {
                if (fabsf(jobs[k].degrees - degrees) <= 1e-6f) { values[n++] = jobs[k].way[m][i]; }
            }
            double middle = results_median(n, values);
            double low = values[(size_t)(0.25 * (double)(n - 1) + 0.5)];
            double high = values[(size_t)(0.75 * (double)(n - 1) + 0.5)];
            fprintf(csv, "\"%s\",%g,%d,%.3e,%.3e,%.3e\n", names[m], (double)degrees, i, low, middle, high);
            plot_point *q = plot_add(s, i, middle);
            q->size = 0.5;
            if (i % 10 == 5 * m) { q->y_low = low, q->y_high = high; }
        }
    }
    results_close(r, csv, "pose_curve", ".csv");
    a = plot_add_panel(&p, "found", "degrees off at the start", "percent", PLOT_ZERO_Y);
    for (int w = 0; w < WAYS; w++) {
        plot_series *s = plot_add_series(a, way_names[w]);
        for (int i = 0; i < levels; i++) {
            summary found = summary_of(count, jobs, starts[i], w);
            plot_add(s, (double)starts[i], 100.0 * found.explained / found.count);
        }
    }
    p.notes[0] = "bars: from the first to the third quarter";
    plot_write(&p, path_of(path, results_stem(r, "pose"), ".svg"), results_machine());
    puts(path);
}

static void write_tables(const results *r, int count, const job *jobs, int levels, const float *starts)
{
    FILE *csv = results_csv(r, "pose", "degrees_start,distance_start,trial,shape,method,degrees_end,distance_end,"
                                       "found,explained,queries");
    for (int i = 0; i < count; i++) {
        for (int w = 0; w < WAYS; w++) {
            const ending *e = &jobs[i].end[w];
            fprintf(csv, "%g,%g,%d,%d,\"%s\",%.3e,%.3e,%d,%d,%llu\n", (double)jobs[i].degrees,
                    (double)jobs[i].distance, jobs[i].trial, jobs[i].index, way_names[w], e->degrees, e->distance,
                    e->found, e->explained, e->queries);
        }
    }
    results_close(r, csv, "pose", ".csv");
    FILE *md = results_section(r, "pose", "Cameras from one depth image", "build/results_pose");
    fprintf(md, "Found: within %g degrees and %g, or another pose with the same picture (a round table turned); "
                "in parentheses the median of the degrees off in the end. The paper shows one aeroplane, without a "
                "number. Each start is also moved by a hundredth a degree, 0.3 at most.\n\n| start off by |",
            GOOD_DEGREES, GOOD_DISTANCE);
    for (int w = 0; w < WAYS; w++) { fprintf(md, " %s |", way_names[w]); }
    fputs("\n|---|---|---|---|---|\n", md);
    for (int i = 0; i < levels; i++) {
        fprintf(md, "| %g degrees |", (double)starts[i]);
        for (int w = 0; w < WAYS; w++) {
            summary s = summary_of(count, jobs, starts[i], w);
            fprintf(md, " %d of %d (%.1g) |", s.explained, s.count, s.degrees);
        }
        fputc('\n', md);
    }
    fputs("\n[pose_curve.csv](pose_curve.csv)\n\n![error over steps, and share found](pose.svg)\n", md);
    results_close(r, md, "pose", ".md");
}

int main(int argc, char **argv)
{
    static const float starts[] = {5, 10, 20, 40, 60, 90};
    results r = results_options(argc, argv, results_usage);
    if (!results_wanted(&r, "pose")) { fail("--only takes pose"); }
    int levels = r.quick ? 2 : 6;
    int trials = r.quick ? 2 : 8;
    request base = request_defaults();
    if (r.quick) { base.fit.iterations = 20; }
    base.fit.view.width = base.fit.view.height = r.quick ? 32 : 64;
    base.fit.settings.workers = 1;
    if (r.quick) { base.restarts = 1; }
    dist_context *ctx = dist_context_create(NULL);
    dist_net *net = load_model(ctx, "embedded");
    job *jobs = (job *)take((size_t)(levels * trials), sizeof *jobs);
    for (int i = 0; i < levels * trials; i++) {
        rng random = rng_begin((unsigned)(i % trials));
        jobs[i].trial = i % trials;
        jobs[i].index = (int)rng_index(&random, (size_t)dist_net_code_count(net));
        jobs[i].degrees = starts[i / trials];
        jobs[i].distance = fminf(0.01f * jobs[i].degrees, 0.3f);
    }
    run_jobs(net, &base, levels * trials, jobs);
    write_tables(&r, levels * trials, jobs, levels, starts);
    write_ways(&r, levels * trials, jobs, levels, starts, starts[r.quick ? 1 : 2], base.fit.iterations + base.refine);
    free(jobs);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
