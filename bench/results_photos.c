/* SPDX-License-Identifier: MIT-0
   results_photos.c - shapes from posed photos alone, by rays and by the mesh-based baseline: the paper's table and its
   figure of robustness, on the embedded decoder. Both fits are those of examples/fit_photos.c and differ in where a
   pixel's depth and its gradient come from: the sphere tracer, or a mesh extracted anew in every step and a z-buffer.

   The baseline is no PMO: it has the same decoder, the same loss, the same steps. So what is compared is the
   representation, not the training, and no number here is to be held against one of the paper's. */
#define _POSIX_C_SOURCE 200112L /* clock_gettime */
#include <time.h>
#define main fit_photos_main
int fit_photos_main(int argc, char **argv);
#include "../examples/fit_photos.c"
#undef main
#include "plot.h"
#include "results.h"

static const char results_usage[] =
    "results_photos [options]: photos\n" RESULTS_USAGE;

enum { FIRST_PLANE = 64, FIRST_CAR = 192, MOST_JOBS = 256 };

/* One fit. */
typedef struct job {
    const char *part, *family;
    int target, seed, mesh;
    float level; /* noise: of the start, in root mean squares of the codes; focal: times that of the others */
    const request *base;
    score scores[2];
    double seconds;
} job;

/* The start: any code, or the true one with noise. */
static float *start_code(const dist_net *net, const job *j, const float *target)
{
    char text[32];
    float *code = NULL;
    snprintf(text, sizeof text, "random:%d", j->seed);
    code = choose_code(net, text);
    if (strcmp(j->part, "noise") == 0) {
        for (int i = 0; i < dist_net_code_size(net); i++) { code[i] = target[i] + j->level * code[i]; }
    }
    return code;
}

static void run_job(const dist_net *net, job *j)
{
    request r = *j->base;
    char text[32];
    dist_context *ctx = dist_context_create(&r.settings);
    double *loss = (double *)take(3 * (size_t)r.iterations, sizeof *loss);
    snprintf(text, sizeof text, "%d", j->target);
    r.gradient = j->mesh ? GRADIENT_MESH : DIST_GRADIENT_AUTO;
    if (strcmp(j->part, "focal") == 0) {
        r.fov = 2.0f * atanf(tanf(r.fov * PI / 360.0f) / j->level) * 180.0f / PI;
    }
    float *target = choose_code(net, text);
    fit f = fit_create(&r, net, ctx, target);
    f.now.code = start_code(net, j, target);
    f.now.place = start_place(&r, 0);
    j->scores[0] = fit_score(&f);
    double begin = thread_seconds();
    fit_run(&f, loss);
    j->seconds = thread_seconds() - begin;
    j->scores[1] = fit_score(&f);
    for (int k = 0; k < 2; k++) { /* no surface at all */
        if (j->scores[k].chamfer < 0) { j->scores[k].chamfer = 1.0; }
    }
    fit_destroy(&f);
    free(target);
    free(loss);
    dist_context_destroy(ctx);
}

/* Fits beside each other, one thread each; every job has a place of its own, so their order does not matter. */
static void run_jobs(const dist_net *net, int count, job *jobs)
{
#ifdef _OPENMP
#pragma omp parallel for schedule(dynamic, 1)
#endif
    for (int i = 0; i < count; i++) {
        run_job(net, &jobs[i]);
        fprintf(stderr, "%s %s %d %g %s: Chamfer x 1000 %.3f -> %.3f, %.0f s\n", jobs[i].part, jobs[i].family,
                jobs[i].target, (double)jobs[i].level, jobs[i].mesh ? "mesh" : "rays",
                1000 * jobs[i].scores[0].chamfer, 1000 * jobs[i].scores[1].chamfer, jobs[i].seconds);
    }
}

/* Of the jobs of one part, family, level and method. */
typedef struct summary {
    int count, good;
    double start, end, best, worst, seconds; /* start, end, seconds: medians; Chamfer x 1000 */
} summary;

static summary summary_of(int count, const job *jobs, const char *part, const char *family, float level, int mesh)
{
    double start[MOST_JOBS], end[MOST_JOBS], seconds[MOST_JOBS];
    summary s;
    size_t n = 0;
    memset(&s, 0, sizeof s);
    for (int i = 0; i < count; i++) {
        const job *j = &jobs[i];
        if (strcmp(j->part, part) != 0 || strcmp(j->family, family) != 0 || j->mesh != mesh ||
            fabsf(j->level - level) > 1e-6f) {
            continue;
        }
        start[n] = 1000 * j->scores[0].chamfer;
        end[n] = 1000 * j->scores[1].chamfer;
        seconds[n++] = j->seconds;
        s.good += 3 * j->scores[1].chamfer <= j->scores[0].chamfer;
        s.best = n == 1 ? end[0] : fmin(s.best, 1000 * j->scores[1].chamfer);
        s.worst = fmax(s.worst, 1000 * j->scores[1].chamfer);
    }
    s.count = (int)n;
    s.start = results_median(n, start);
    s.end = results_median(n, end);
    s.seconds = results_median(n, seconds);
    return s;
}

/* Both figures of robustness: medians, and from the best to the worst. */
static void write_plot(const results *r, int count, const job *jobs)
{
    static const char *const names[2] = {"rays", "mesh"};
    char path[PATH_SIZE];
    plot p = plot_begin("Shapes from photos: cars", "rays: the sphere tracer; mesh: extracted anew in every step", 2);
    plot_panel *a = plot_add_panel(&p, "noise in the start", "root mean squares of the codes",
                                   "Chamfer distance x 1000", PLOT_LOG_Y);
    for (int part = 0; part < 2; part++) {
        const char *wanted = part ? "focal" : "noise";
        if (part) {
            a = plot_add_panel(&p, "another focal length", "times the table's", "Chamfer distance x 1000",
                               PLOT_LOG_X | PLOT_LOG_Y);
        }
        for (int i = 0; i < count; i++) {
            summary s = summary_of(count, jobs, wanted, "car", jobs[i].level, jobs[i].mesh);
            if (strcmp(jobs[i].part, wanted) != 0 || jobs[i].seed != 1) { continue; }
            plot_point *q = plot_add(plot_series_of(a, names[jobs[i].mesh]), (double)jobs[i].level, s.end);
            q->y_low = s.best;
            q->y_high = s.worst;
            q->open = s.good < s.count;
        }
    }
    p.open_means = "some end above a third of the start's distance";
    p.notes[0] = "bars: from the best to the worst";
    plot_write(&p, path_of(path, results_stem(r, "photos"), ".svg"), results_machine());
    puts(path);
}

static void write_csv(const results *r, int count, const job *jobs)
{
    FILE *csv = results_csv(r, "photos", "part,family,target,seed,level,method,width,views,iterations,"
                                         "chamfer1000_start,chamfer1000_end,loss_start,loss_end,cpu_seconds");
    for (int i = 0; i < count; i++) {
        const job *j = &jobs[i];
        fprintf(csv, "%s,%s,%d,%d,%g,%s,%d,%d,%d,%.4f,%.4f,%.5f,%.5f,%.2f\n", j->part, j->family, j->target, j->seed,
                (double)j->level, j->mesh ? "mesh" : "rays", j->base->width, j->base->views, j->base->iterations,
                1000 * j->scores[0].chamfer, 1000 * j->scores[1].chamfer, j->scores[0].loss, j->scores[1].loss,
                j->seconds);
    }
    results_close(r, csv, "photos", ".csv");
}

static void write_section(const results *r, int count, const job *jobs, int noises, const float *noise, int focals,
                          const float *focal)
{
    static const char *const families[2] = {"car", "plane"};
    static const char *const published[2] = {"0.661 / 1.187 / 0.919", "1.129 / 6.124 / 1.595"};
    FILE *md = results_section(r, "photos", "Shapes from photos, by rays and by a mesh", "build/results_photos");
    fprintf(md, "From a random code, posed photos alone (no mask, no depth). Chamfer distance x 1000 from the truth to "
                "the shape, median (worst); good: a third of the start's or less. "
                "Seconds: of one thread's processor time, without the scores. The published numbers are of other "
                "shapes and decoders, and PMO is another program with its own training.\n\n"
                "| | start | rays | good | seconds | mesh | good | seconds | published: PMO / PMO random / paper |\n"
                "|---|---|---|---|---|---|---|---|---|\n");
    for (int k = 0; k < 2; k++) {
        summary a = summary_of(count, jobs, "table", families[k], 0, 0);
        summary b = summary_of(count, jobs, "table", families[k], 0, 1);
        if (!a.count) { continue; }
        fprintf(md, "| %ss | %.1f | %.2f (%.2f) | %d of %d | %.1f | %.2f (%.2f) | %d of %d | %.1f | %s |\n",
                families[k], a.start, a.end, a.worst, a.good, a.count, a.seconds, b.end, b.worst, b.good, b.count,
                b.seconds, published[k]);
    }
    fprintf(md, "\nRobustness, cars: the start is the true code with noise (in root mean squares of the decoder's "
                "codes), or random with photos of another focal length, which the fit knows.\n\n"
                "| | start | rays | good | mesh | good |\n|---|---|---|---|---|---|\n");
    for (int k = 0; k < noises + focals; k++) {
        const char *part = k < noises ? "noise" : "focal";
        float level = k < noises ? noise[k] : focal[k - noises];
        summary a = summary_of(count, jobs, part, "car", level, 0);
        summary b = summary_of(count, jobs, part, "car", level, 1);
        fprintf(md, "| %s %g | %.1f | %.2f (%.2f) | %d of %d | %.2f (%.2f) | %d of %d |\n",
                k < noises ? "noise" : "focal length x", (double)level, a.start, a.end, a.worst, a.good, a.count, b.end,
                b.worst, b.good, b.count);
    }
    fputs("\n![noise in the start, focal length](photos.svg)\n", md);
    results_close(r, md, "photos", ".md");
}

static request base_request(int size, int views, int iterations, int cells)
{
    request r;
    memset(&r, 0, sizeof r);
    r.model = r.texture = "embedded";
    r.width = r.height = size;
    r.views = views;
    r.batch = 8;
    r.iterations = iterations;
    r.rate = 0.01f;
    r.weights[0] = 5.0f;
    r.weights[1] = 1.0f;
    r.blur = 4.0f;
    r.cells = cells;
    r.place[0] = 1.0f;
    r.fov = 45.0f;
    r.settings.workers = 1;
    return r;
}

static int add_jobs(int count, job *jobs, const request *base, const char *part, const char *family, int levels,
                    const float *level, int trials)
{
    int first = strcmp(family, "car") == 0 ? FIRST_CAR : FIRST_PLANE;
    for (int k = 0; k < levels * trials * 2; k++) {
        job *j = &jobs[count + k];
        memset(j, 0, sizeof *j);
        j->part = part;
        j->family = family;
        j->level = level[k / 2 / trials];
        j->mesh = k % 2;
        j->seed = 1 + k / 2 % trials;
        j->target = first + (5 + 11 * (k / 2 % trials)) % 64;
        j->base = base;
    }
    return count + levels * trials * 2;
}

int main(int argc, char **argv)
{
    static const float none[1] = {0};
    static const float noise[] = {0.5f, 1.0f, 2.0f};
    static const float focal[] = {0.6f, 1.0f, 1.6f};
    results r = results_options(argc, argv, results_usage);
    if (!results_wanted(&r, "photos")) { fail("--only takes photos"); }
    job jobs[MOST_JOBS];
    int count = 0;
    int levels = r.quick ? 1 : 3;
    request full = r.quick ? base_request(32, 8, 8, 16) : base_request(112, 24, 64, 48);
    request small = r.quick ? full : base_request(80, 24, 64, 48); /* of the figure, with more fits */
    count = add_jobs(count, jobs, &full, "table", "car", 1, none, r.quick ? 1 : 5);
    if (!r.quick) { count = add_jobs(count, jobs, &full, "table", "plane", 1, none, 5); }
    count = add_jobs(count, jobs, &small, "noise", "car", levels, noise, r.quick ? 1 : 4);
    count = add_jobs(count, jobs, &small, "focal", "car", levels, focal, r.quick ? 1 : 4);
    dist_context *ctx = dist_context_create(NULL);
    dist_net *net = load_model(ctx, "embedded");
    run_jobs(net, count, jobs);
    write_csv(&r, count, jobs);
    write_plot(&r, count, jobs);
    write_section(&r, count, jobs, levels, noise, levels, focal);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
