/* SPDX-License-Identifier: MIT-0
   bench_trace.c - how many queries a picture takes, and how exact it is, against a reference found by small steps.
   CSV on stdout. The camera is 2.2 radii away (azimuth 35, elevation 25 degrees) with a focal length of 385 pixels at
   512, so that there about 121,000 rays meet the bounding sphere, as in the paper's table of queries. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"
#include "ladder.h"

static const char usage[] =
    "bench_trace [options]\n"
    "  --ladder MODEL     the paper's rows and the guarded tracer on one decoder, beside the paper's own counts;\n"
    "                     a file, the word embedded, or sphere, torus or box\n"
    "  --code N           its code (default 0)\n"
    "  --size N           pixels along a side (default 512; without --ladder: 128, 256 and 512)\n"
    "  --steps N          of the paper's rows: 50 (default) or 100\n"
    "  --case NAME        without --ladder: only this one\n"
    "  --slow             also the decoders of 8 x 512 and with layer norm\n"
    "  --quick            128 and 512 pixels, few cases\n";

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

enum { CASES = sizeof cases / sizeof cases[0], FIRST_SHORT = 3 };

static void print_result(const char *name, const method *m, int size, const result *r)
{
    printf("%s,%s,%d,%.2g,%llu,%.4f,%.0f,%.2e,%.2e,%.2e,%.0f,%.0f,%llu", name, m->name, size, (double)r->stats.epsilon,
           r->stats.queries, r->seconds, (double)r->hits, r->mean, r->p99, r->largest, (double)r->holes,
           (double)r->false_hits, r->silhouette_queries);
}

/* All methods on one field. scaled: queries where the parallel row has the paper's 6.06 million. */
static void ladder(dist_context *ctx, const char *name, const dist_field *field, int size, int steps)
{
    dist_camera camera = bench_camera(field, size, size);
    reference ref = reference_create(ctx, field, &camera);
    double parallel = 0;
    for (int m = 0; m < METHODS; m++) {
        dist_render_desc how = method_desc(&methods[m], methods[m].trace == DIST_TRACE_PAPER ? steps : 0);
        result r = trace_once(ctx, field, &camera, &how, &ref);
        if (m == 0) { parallel = (double)r.stats.queries; }
        print_result(name, &methods[m], size, &r);
        double paper = published_queries(&methods[m], steps);
        printf(",%.0f,", parallel > 0 ? (double)r.stats.queries / parallel * 6.06e6 * (steps / 50.0) : 0);
        if (paper > 0) { printf("%.0f", 1e6 * paper); }
        putchar('\n');
        fflush(stdout);
    }
    reference_destroy(&ref);
}

/* only_size 0: several. */
static void run_case(dist_context *ctx, const trace_case *c, int only_size, int quick)
{
    dist_net *net = c->net ? load_net_or_skip(ctx, c->net) : NULL;
    if (c->net && !net) { return; }
    dist_shape *shape = NULL;
    dist_field field = field_of(ctx, c->name, net, c->code, &shape);
    for (int size = only_size ? only_size : 128; size <= (only_size ? only_size : 512); size *= quick ? 4 : 2) {
        dist_camera camera = bench_camera(&field, size, size);
        reference ref = reference_create(ctx, &field, &camera);
        for (int m = FIRST_SHORT; m < METHODS; m++) {
            dist_render_desc how = method_desc(&methods[m], methods[m].trace == DIST_TRACE_PAPER ? 50 : 0);
            result r = trace_once(ctx, &field, &camera, &how, &ref);
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
    int size = 0;
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
    printf("case,method,resolution,epsilon,queries,seconds,hits,mean_error,p99_error,max_error,holes,false_hits,"
           "silhouette_queries%s\n",
           ladder_of ? ",scaled_queries,paper_queries" : "");
    if (ladder_of) {
        dist_shape *shape = NULL;
        dist_net *net = is_analytic(ladder_of) ? NULL : load_model(ctx, ladder_of);
        dist_field field = field_of(ctx, ladder_of, net, code, &shape);
        ladder(ctx, ladder_of, &field, size ? size : 512, steps);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    int found = ladder_of != NULL;
    for (int i = 0; !ladder_of && i < CASES; i++) {
        const trace_case *c = &cases[i];
        int wanted = only ? strcmp(only, c->name) == 0 : quick ? c->quick : slow || !c->slow;
        if (!wanted) { continue; }
        run_case(ctx, c, size, quick);
        found = 1;
    }
    check_found("--case", only, found);
    dist_context_destroy(ctx);
    return 0;
}
