/* SPDX-License-Identifier: MIT-0
   bench_fit.c - which gradient fits best: codes of real decoders moved from one shape to another by the depth and
   silhouette of one view, once for every way to trace and to differentiate. CSV on stdout; the networks are test data
   that the repository does not hold, and what is missing is skipped. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "../examples/fit.h"
#include "bench.h"

static const char usage[] =
    "bench_fit [options]\n"
    "  --case NAME        only this one\n"
    "  --mode NAME        only this one: implicit, normal, paper, guarded2, guarded3, paper1 or paper3\n"
    "  --iterations N     steps of Adam (default 100)\n"
    "  --rate R           its rate (default 0.01)\n"
    "  --size N           pixels along a side of the picture (default 96)\n"
    "  --slow             also the fits of the decoder of 8 x 512\n"
    "  --quick            a small picture, few steps and only the first case that is there\n";

typedef struct fit_case {
    const char *name, *net, *target, *start;
    int slow;
} fit_case;

/* target and start: codes as choose_code understands them. */
static const fit_case cases[] = {
    {"bob_spot_0_from_1", "bob_spot", "0", "1", 0},
    {"bob_spot_1_from_0", "bob_spot", "1", "0", 0},
    {"embedded_5_from_mean", "embedded", "5", "mean", 0},
    {"embedded_70_from_mean", "embedded", "70", "mean", 0},
    {"embedded_5_from_70", "embedded", "5", "70", 0},
    {"primitives_13_from_15", "primitives", "13", "15", 0},
    {"chairs_3_from_1", "chairs", "3", "1", 0},
    {"mug_0_from_mean", "mug_camera_bottle", "0", "mean", 0},
    {"mug_1_from_mean", "mug_camera_bottle", "1", "mean", 0},
    {"spot_512_from_mean", "deepsdf_512", "0", "mean", 1},
    {"chair_512_from_mean", "deepsdf_512", "8", "mean", 1},
};

typedef struct fit_mode {
    const char *name;
    int trace, gradient, samples;
} fit_mode;

static const fit_mode modes[] = {
    {"implicit", DIST_TRACE_GUARDED, DIST_GRADIENT_IMPLICIT, 1},
    {"normal", DIST_TRACE_GUARDED, DIST_GRADIENT_NORMAL, 1},
    {"paper", DIST_TRACE_GUARDED, DIST_GRADIENT_PAPER, 1},
    {"guarded3", DIST_TRACE_GUARDED, DIST_GRADIENT_PAPER, 3},
    {"guarded2", DIST_TRACE_GUARDED, DIST_GRADIENT_PAPER, 2},
    {"paper1", DIST_TRACE_PAPER, DIST_GRADIENT_PAPER, 1},
    {"paper3", DIST_TRACE_PAPER, DIST_GRADIENT_PAPER, 3},
};

enum { CASES = sizeof cases / sizeof cases[0], MODES = sizeof modes / sizeof modes[0] };

static const char *trace_name(const fit_mode *mode)
{
    return mode->trace == DIST_TRACE_PAPER ? "paper" : "guarded";
}

typedef struct settings {
    const char *only_case, *only_mode;
    int iterations, size, slow, quick;
    float rate;
} settings;

/* What is rendered, and what is kept for its gradient. */
typedef struct planes {
    float *depth, *silhouette, *d_depth, *d_silhouette;
    unsigned char *mask;
} planes;

/* Every result is judged by the same tracer, whichever has fitted it. */
static void render_reference(dist_context *ctx, dist_shape *shape, const float *code, const dist_camera *camera,
                             float *depth, unsigned char *mask)
{
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    out.mask = mask;
    dist_shape_set_code(shape, code);
    dist_field field = dist_shape_field(shape);
    dist_render(ctx, &field, camera, NULL, &out, NULL);
    check(ctx);
}

/* Moves the code; returns the seconds. */
static double fit_run(dist_context *ctx, const settings *s, const fit_mode *mode, dist_shape *shape, size_t code_size,
                      float *code, const dist_camera *camera, const observation *target, planes *p,
                      dist_stats *total)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.trace = mode->trace;
    how.gradient = mode->gradient;
    how.samples = mode->samples;
    dist_tape *tape = dist_tape_create(ctx, camera, &how);
    dist_stats stats;
    dist_images out;
    dist_images d_out;
    dist_gradients grads;
    dist_adam adam;
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    memset(&adam, 0, sizeof adam);
    memset(total, 0, sizeof *total);
    out.depth = p->depth, out.silhouette = p->silhouette, out.mask = p->mask;
    d_out.depth = p->d_depth, d_out.silhouette = p->d_silhouette;
    out.stats = d_out.stats = &stats;
    grads.code = take_floats(code_size);
    adam.moments = take_floats(2 * code_size);
    adam.rate = s->rate;
    double start = seconds_now();
    for (int i = 0; i < s->iterations; i++) {
        memset(&stats, 0, sizeof stats);
        memset(grads.code, 0, code_size * sizeof(float));
        memset(p->d_depth, 0, target->n * sizeof(float));
        memset(p->d_silhouette, 0, target->n * sizeof(float));
        dist_shape_set_code(shape, code);
        dist_field field = dist_shape_field(shape);
        dist_render(ctx, &field, camera, &how, &out, tape);
        dist_loss_depth(target->n, p->depth, target->depth, p->mask, 10.0f, p->d_depth);
        dist_loss_silhouette(target->n, p->silhouette, target->mask, 1.0f, p->d_silhouette);
        dist_loss_code(code_size, code, 1.0f / (float)code_size, grads.code);
        dist_render_backward(ctx, tape, &d_out, &grads);
        check(ctx);
        dist_adam_step(&adam, code_size, code, grads.code);
        add_stats(total, &stats);
    }
    double seconds = seconds_now() - start;
    free(grads.code);
    free(adam.moments);
    dist_tape_destroy(tape);
    return seconds;
}

/* Sums of one mode over all cases. */
typedef struct tally {
    int count;
    double log_ratio, iou_start, iou_end, queries, seconds;
} tally;

static void fit_one(dist_context *ctx, const settings *s, const fit_case *c, const dist_net *net, tally *tallies)
{
    view v = view_default(s->size, s->size);
    dist_camera camera = view_camera(&v, 0.0f);
    size_t code_size = (size_t)dist_net_code_size(net);
    float *goal = choose_code(net, c->target);
    float *begin = choose_code(net, c->start);
    float *code = take_floats(code_size);
    observation target = observation_create(s->size, s->size);
    planes p;
    p.depth = take_floats(4 * target.n);
    p.silhouette = p.depth + target.n;
    p.d_depth = p.silhouette + target.n;
    p.d_silhouette = p.d_depth + target.n;
    p.mask = (unsigned char *)take(target.n, 1);
    dist_shape *shape = dist_shape_create(ctx, net, goal);
    check(ctx);
    render_reference(ctx, shape, goal, &camera, target.depth, target.mask);
    render_reference(ctx, shape, begin, &camera, p.depth, p.mask);
    score before = score_pictures(&target, p.depth, p.mask);
    for (int m = 0; m < MODES; m++) {
        const fit_mode *mode = &modes[m];
        if (s->only_mode && strcmp(s->only_mode, mode->name) != 0) { continue; }
        dist_stats total;
        memcpy(code, begin, code_size * sizeof(float));
        double seconds = fit_run(ctx, s, mode, shape, code_size, code, &camera, &target, &p, &total);
        render_reference(ctx, shape, code, &camera, p.depth, p.mask);
        score after = score_pictures(&target, p.depth, p.mask);
        double ratio = after.depth_error / before.depth_error;
        printf("%s,%s,%s,%d,%.6f,%.6f,%.4f,%.4f,%.4f,%llu,%.2f\n", c->name, trace_name(mode),
               gradient_name(mode->gradient), mode->samples, before.depth_error, after.depth_error, ratio, before.iou,
               after.iou, total.queries, seconds);
        fflush(stdout);
        if (!(before.depth_error > 0 && after.depth_error > 0)) { continue; }
        tallies[m].count++;
        tallies[m].log_ratio += log(ratio);
        tallies[m].iou_start += before.iou;
        tallies[m].iou_end += after.iou;
        tallies[m].queries += (double)total.queries;
        tallies[m].seconds += seconds;
    }
    dist_shape_destroy(shape);
    observation_destroy(&target);
    free(p.depth);
    free(p.mask);
    free(goal);
    free(begin);
    free(code);
}

/* Geometric mean of the ratios, means of the overlaps, sums of the rest. */
static void print_tallies(const tally *tallies)
{
    for (int m = 0; m < MODES; m++) {
        const tally *t = &tallies[m];
        if (t->count == 0) { continue; }
        double k = t->count;
        printf("all_%d,%s,%s,%d,,,%.4f,%.4f,%.4f,%.0f,%.2f\n", t->count,
               trace_name(&modes[m]), gradient_name(modes[m].gradient), modes[m].samples, exp(t->log_ratio / k),
               t->iou_start / k, t->iou_end / k, t->queries, t->seconds);
    }
}

int main(int argc, char **argv)
{
    settings s = {NULL, NULL, 100, 96, 0, 0, 0.01f};
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--case")) {
            s.only_case = option_text(&o);
        } else if (option_is(&o, "--mode")) {
            s.only_mode = option_text(&o);
        } else if (option_is(&o, "--iterations")) {
            s.iterations = option_int(&o, 1, 100000);
        } else if (option_is(&o, "--rate")) {
            s.rate = (float)option_number(&o, 1e-9, 1e3);
        } else if (option_is(&o, "--size")) {
            s.size = option_int(&o, 1, 4096);
        } else if (option_is(&o, "--slow")) {
            s.slow = option_flag(&o);
        } else if (option_is(&o, "--quick")) {
            s.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    if (s.quick) {
        s.size = 32;
        s.iterations = 20;
    }
    dist_context *ctx = dist_context_create(NULL);
    tally tallies[MODES];
    memset(tallies, 0, sizeof tallies);
    puts("case,trace,gradient,samples,depth_error_start,depth_error_end,ratio,iou_start,iou_end,queries,seconds");
    int found = 0;
    for (int m = 0; s.only_mode && m < MODES; m++) {
        found |= strcmp(s.only_mode, modes[m].name) == 0;
    }
    check_found("--mode", s.only_mode, found);
    found = 0;
    for (int i = 0; i < CASES; i++) {
        const fit_case *c = &cases[i];
        if (s.only_case ? strcmp(s.only_case, c->name) != 0 : c->slow && !s.slow) { continue; }
        found = 1;
        dist_net *net = load_net_or_skip(ctx, c->net);
        if (!net) { continue; }
        fit_one(ctx, &s, c, net, tallies);
        dist_net_destroy(net);
        if (s.quick) { break; }
    }
    check_found("--case", s.only_case, found);
    print_tallies(tallies);
    dist_context_destroy(ctx);
    return 0;
}
