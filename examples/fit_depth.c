/* SPDX-License-Identifier: MIT-0
   fit_depth.c - one depth image in, the whole shape out: the decoder's code is moved until the rendered depth and
   silhouette agree with the picture.   cc -O2 examples/fit_depth.c -lm -o fit_depth && ./fit_depth --demo */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"
#include "fit.h"
#include "shapes.h"

static const char usage[] =
    "fit_depth [MODEL] [--target WHICH | --depth FILE.pfm | --demo] [options] --out STEM\n" FIT_USAGE
    "  --start WHICH      zero (default), mean, random:SEED, INDEX or FILE: the code to begin with\n"
    "  --demo             see a shape that the embedded model was never shown, 5 % of its pixels, start from the mean\n"
    "  --demo-family NAME of sofas (default), planes, tables, cars: what the shape is\n"
    "  --demo-shape N     which one of them (default 0)\n"
    "  --warm             begin each step's picture with the last one: fewer queries; off because thin shapes seen\n"
    "                     in few points are found worse\n" REPORT_USAGE
    "                     (of the result; of the last step: capped gradients, points of the backward pass)\n";

enum { SNAPSHOTS = 5 };

/* Everything that one step of the fit needs. */
typedef struct fit {
    const fit_options *options;
    dist_context *ctx;
    dist_shape *shape;
    dist_field field;
    dist_camera camera;
    const observation *seen;
    dist_tape *tape;
    size_t code_size;
    float *code, *d_code;
    dist_images out, d_out;
    dist_render_desc how;  /* with the observed pixels alone where no silhouette is compared */
    unsigned char *pixels; /* those that are observed */
    dist_stats stats;
    dist_stats last;       /* of the last step, backward included */
    double render_seconds; /* of the picture in out */
} fit;

static fit fit_create(dist_context *ctx, const dist_net *net, const fit_options *o, const dist_camera *camera,
                      const observation *seen, float *code, int report, int warm)
{
    fit f;
    memset(&f, 0, sizeof f);
    f.options = o;
    f.ctx = ctx;
    f.shape = dist_shape_create(ctx, net, code);
    f.field = dist_shape_field(f.shape);
    f.camera = *camera;
    f.seen = seen;
    f.how = o->how;
    f.how.warm_start = warm && o->how.trace == DIST_TRACE_GUARDED && !o->no_mask && o->weights[1] > 0.0f;
    f.tape = dist_tape_create(ctx, camera, &f.how);
    f.code_size = (size_t)dist_net_code_size(net);
    f.code = code;
    f.d_code = take_floats(f.code_size);
    f.out.depth = take_floats(seen->n);
    f.d_out.depth = take_floats(seen->n);
    f.out.mask = (unsigned char *)take(seen->n, 1);
    if (report) {
        f.out.distance = take_floats(seen->n);
        f.out.error = take_floats(seen->n);
    }
    f.pixels = (unsigned char *)take(seen->n, 1);
    for (size_t i = 0; i < seen->n; i++) {
        f.pixels[i] = seen->seen[i] > 0.0f;
    }
    if (!o->no_mask && o->weights[1] > 0.0f) {
        f.out.silhouette = take_floats(seen->n);
        f.d_out.silhouette = take_floats(seen->n);
    }
    if (!f.out.silhouette) { f.how.pixels = f.pixels; }
    check(ctx);
    return f;
}

static void fit_destroy(fit *f)
{
    dist_tape_destroy(f->tape);
    dist_shape_destroy(f->shape);
    free(f->d_code);
    free(f->out.depth);
    free(f->d_out.depth);
    free(f->out.mask);
    free(f->out.distance);
    free(f->out.error);
    free(f->pixels);
    free(f->out.silhouette);
    free(f->d_out.silhouette);
}

/* Renders the shape of the present code and compares: the loss, its three terms, and their gradients in d_out, d_code.
   The prior is the mean of squares, as in the authors' code. */
static double fit_loss(fit *f, double terms[3])
{
    const observation *s = f->seen;
    const float *weights = f->options->weights;
    memset(f->d_code, 0, f->code_size * sizeof(float));
    memset(f->d_out.depth, 0, s->n * sizeof(float));
    if (f->d_out.silhouette) { memset(f->d_out.silhouette, 0, s->n * sizeof(float)); }
    memset(&f->stats, 0, sizeof f->stats);
    f->out.stats = &f->stats;
    f->d_out.stats = &f->stats;

    dist_shape_set_code(f->shape, f->code);
    double start = seconds_now();
    dist_render(f->ctx, &f->field, &f->camera, &f->how, &f->out, f->tape);
    f->render_seconds = seconds_now() - start;
    check(f->ctx);
    terms[0] = (double)dist_loss_depth(s->n, f->out.depth, s->seen, f->out.mask, weights[0], f->d_out.depth);
    terms[1] = 0;
    if (f->out.silhouette) {
        terms[1] =
            (double)dist_loss_silhouette_wrong(s->n, f->out.silhouette, s->mask, weights[1], f->d_out.silhouette);
    }
    terms[2] = (double)dist_loss_code(f->code_size, f->code, weights[2] / (float)f->code_size, f->d_code);
    return terms[0] + terms[1] + terms[2];
}

/* The fit itself. loss: (iterations, 4), total and terms; path: (iterations + 1, code_size), the codes on the way. */
static double fit_run(fit *f, double *loss, float *path, dist_stats *total)
{
    int iterations = f->options->iterations;
    size_t code_bytes = f->code_size * sizeof(float);
    dist_gradients grads;
    dist_adam adam;
    memset(&grads, 0, sizeof grads);
    memset(&adam, 0, sizeof adam);
    grads.code = f->d_code;
    adam.rate = f->options->rate;
    adam.moments = take_floats(2 * f->code_size);
    progress p = progress_begin("fitting");
    double start = seconds_now();
    for (int i = 0; i < iterations; i++) {
        memcpy(path + (size_t)i * f->code_size, f->code, code_bytes);
        loss[4 * i] = fit_loss(f, loss + 4 * i + 1);
        dist_render_backward(f->ctx, f->tape, &f->d_out, &grads);
        check(f->ctx);
        dist_adam_step(&adam, f->code_size, f->code, f->d_code);
        add_stats(total, &f->stats);
        progress_show(&p, i + 1, iterations, "loss", loss[4 * i]);
    }
    double seconds = seconds_now() - start;
    f->last = f->stats;
    memcpy(path + (size_t)iterations * f->code_size, f->code, code_bytes);
    progress_end(&p);
    free(adam.moments);
    return seconds;
}

/* Loss and picture scores of one code; with target points also Chamfer. *mesh gets the surface if asked for. */
static score fit_score(fit *f, const float *code, const float *target_points, double terms[3], dist_mesh **mesh)
{
    const unsigned char *pixels = f->how.pixels;
    memcpy(f->code, code, f->code_size * sizeof(float));
    int warm = f->how.warm_start;
    f->how.pixels = NULL; /* scores are about the whole picture, from nothing */
    f->how.warm_start = 0;
    double loss = fit_loss(f, terms);
    f->how.pixels = pixels;
    f->how.warm_start = warm;
    score result = score_pictures(f->seen, f->out.depth, f->out.mask);
    result.loss = loss;
    float *points = NULL;
    if (target_points || mesh) {
        dist_mesh *surface = surface_of(f->ctx, &f->field, &points);
        result.chamfer = chamfer_between(f->ctx, points, target_points);
        if (mesh) { *mesh = surface; }
        if (!mesh) { dist_mesh_destroy(surface); }
    }
    free(points);
    return result;
}

/* ---- report ------------------------------------------------------------------------------------------------------ */

/* What was seen, the way from the start to the result, the truth if it is known, and the error that is left; the depth
   and mask of the result are still in f->out. */
static void write_strip(fit *f, const float *path)
{
    const fit_options *o = f->options;
    const observation *s = f->seen;
    int steps[SNAPSHOTS] = {0, o->iterations / 20, o->iterations / 7, o->iterations * 2 / 5, o->iterations};
    int zoom = picture_zoom(s->width, s->height);
    canvas pictures[SNAPSHOTS + 3];
    char text[SNAPSHOTS + 3][32];
    const char *captions[SNAPSHOTS + 3];
    int count = 0;
    pictures[count] = picture_seen(s, !o->no_mask);
    canvas_enlarge(&pictures[count], zoom);
    snprintf(text[count++], sizeof text[0], "seen: %.0f pixels", (double)s->seen_count);
    for (int i = 0; i < SNAPSHOTS; i++) {
        if (i > 0 && steps[i] == steps[i - 1]) { continue; }
        dist_shape_set_code(f->shape, path + (size_t)steps[i] * f->code_size);
        pictures[count] = picture_field(f->ctx, &f->field, &f->camera);
        const char *name = i == 0 ? "start" : i + 1 == SNAPSHOTS ? "result, step" : "step";
        snprintf(text[count++], sizeof text[0], i == 0 ? "%s" : "%s %d", name, steps[i]);
    }
    int owned = count;
    if (s->truth.rgb) {
        pictures[count] = s->truth;
        snprintf(text[count++], sizeof text[0], "truth");
    }
    canvas error = picture_error(s->width, s->height, f->out.depth, f->out.mask, s->depth, s->mask, 0.1f);
    canvas_enlarge(&error, zoom);
    pictures[count] = error;
    snprintf(text[count++], sizeof text[0], "depth error, to 0.1");
    for (int i = 0; i < count; i++) {
        captions[i] = text[i];
    }
    canvas strip = picture_sheet(count, pictures, captions, (count + 1) / 2);
    printf("%s\n", write_canvas(o->out, &strip));
    for (int i = 0; i < owned; i++) {
        canvas_destroy(&pictures[i]);
    }
    canvas_destroy(&error);
}

static void write_loss(const fit_options *o, const double *loss)
{
    static const char *const names[] = {"loss", "depth", "silhouette", "code prior"};
    size_t n = (size_t)o->iterations + 1;
    double *columns = (double *)take(4 * n, sizeof *columns);
    curve curves[4];
    size_t count = 0;
    for (size_t k = 0; k < 4; k++) {
        double largest = 0;
        for (size_t i = 0; i < n; i++) {
            columns[k * n + i] = loss[4 * i + k];
            largest = loss[4 * i + k] > largest ? loss[4 * i + k] : largest;
        }
        if (!(largest > 0)) { continue; }
        curves[count].name = names[k];
        curves[count].n = n;
        curves[count].x = NULL;
        curves[count++].y = columns + k * n;
    }
    char path[PATH_SIZE];
    path_of(path, o->out, "_loss.svg");
    write_curves(path, "loss of the fit", "step", "weighted loss", count, curves, 1);
    printf("%s\n", path);
    free(columns);
}

static void write_report(const fit *f, const score scores[2], const dist_stats *total, double seconds)
{
    static const char *const when[] = {"start", "end"};
    const fit_options *o = f->options;
    char path[PATH_SIZE];
    json j = json_open(path_of(path, o->out, ".json"));
    json_text(&j, "model", o->model);
    json_text(&j, "observed", o->depth_path ? o->depth_path : o->target ? o->target : "the demo's shape");
    for (int i = 0; i < 2; i++) {
        json_score(&j, "loss", when[i], scores[i].loss);
        json_score(&j, "depth_error", when[i], scores[i].depth_error);
        json_score(&j, "iou", when[i], scores[i].iou);
        json_score(&j, "chamfer", when[i], scores[i].chamfer);
    }
    json_count(&j, "queries", total->queries);
    json_number(&j, "seconds", seconds);
    json_count(&j, "iterations", (unsigned long long)o->iterations);
    json_count(&j, "pixels", f->seen->n);
    json_count(&j, "pixels_hit", f->seen->hits);
    json_count(&j, "pixels_seen", f->seen->seen_count);
    json_floats(&j, "weights", 3, o->weights);
    json_number(&j, "rate", (double)o->rate);
    dist_render_desc how = dist_render_desc_resolve(&o->how);
    json_text(&j, "gradient", gradient_name(how.gradient));
    json_text(&j, "trace", how.trace == DIST_TRACE_PAPER ? "paper" : "guarded");
    json_count(&j, "samples", (unsigned long long)how.samples);
    json_count(&j, "seed", (unsigned long long)o->seed);
    json_count(&j, "threads", (unsigned long long)dist_context_workers(f->ctx));
    json_text(&j, "isa", dist_isa_name(dist_context_isa(f->ctx)));
    json_camera(&j, "camera", &f->camera);
    json_stats(&j, "totals", total);
    json_floats(&j, "code", f->code_size, f->code);
    json_close(&j);
    printf("%s\n", path);
}

static void print_number(double value)
{
    if (value < 0) {
        printf("%12s", "none");
    } else {
        printf("%12.6f", value);
    }
}

static void print_row(const char *name, double start, double end)
{
    if (start < 0 && end < 0) { return; }
    printf("  %-12s", name);
    print_number(start);
    printf("  -> ");
    print_number(end);
    putchar('\n');
}

/* Fits, measures before and after, writes all files. target_points: of the true surface, or NULL. bytes: what the
   context's allocator has given. */
static void fit_and_report(fit *f, const float *target_points, const size_t *bytes)
{
    const fit_options *o = f->options;
    size_t steps = (size_t)o->iterations;
    double *loss = (double *)take(4 * (steps + 1), sizeof *loss);
    float *path = take_floats((steps + 1) * f->code_size);
    dist_stats total;
    memset(&total, 0, sizeof total);
    double seconds = fit_run(f, loss, path, &total);

    score scores[2];
    double terms[3];
    dist_mesh *mesh = NULL;
    progress p = progress_begin("measuring the surfaces");
    progress_show(&p, 0, 1, NULL, 0);
    scores[0] = fit_score(f, path, target_points, terms, NULL);
    size_t best = steps;
    for (;;) { /* a fit that ends above its start is taken back to where it was best */
        float *result = path + steps * f->code_size;
        memmove(result, path + best * f->code_size, f->code_size * sizeof *path);
        scores[1] = fit_score(f, result, target_points, loss + 4 * steps + 1, &mesh);
        loss[4 * steps] = scores[1].loss;
        if (best < steps || !(scores[1].loss > scores[0].loss)) { break; }
        best = 0;
        for (size_t i = 1; i < steps; i++) { best = loss[4 * i] < loss[4 * best] ? i : best; }
        dist_mesh_destroy(mesh);
    }
    progress_end(&p);
    if (best < steps) { printf("the loss went up: the result is that of step %.0f, the best\n", (double)best); }

    char name[PATH_SIZE];
    write_report(f, scores, &total, seconds); /* the code first: what comes after may find the disk full */
    dist_mesh_save(f->ctx, mesh, path_of(name, o->out, ".ply"));
    check(f->ctx);
    printf("%s\n", name);
    write_loss(o, loss);
    write_strip(f, path);
    printf("%d steps, %llu queries, %.2f seconds\n", o->iterations, total.queries, seconds);
    print_row("loss", scores[0].loss, scores[1].loss);
    print_row("depth error", scores[0].depth_error, scores[1].depth_error);
    print_row("mask IoU", scores[0].iou, scores[1].iou);
    print_row("Chamfer", scores[0].chamfer, scores[1].chamfer);
    tell_if_not_fallen(scores[0].loss, scores[1].loss, (double)o->rate);
    dist_mesh_destroy(mesh);
    if (f->out.error) {
        dist_shape_set_code(f->shape, f->code); /* write_strip has shown others */
        print_report(f->ctx, &f->field, &f->camera, &o->how, &f->out, f->render_seconds, *bytes);
        print_cell("capped gradients", (double)f->last.capped);
        print_cell("backward points", (double)f->last.backward_points);
        putchar('\n');
    }
    free(loss);
    free(path);
}

/* ---- where the observation comes from ---------------------------------------------------------------------------- */

/* What the user asks for. */
typedef struct request {
    fit_options fit;
    const char *start;
    int demo, demo_family, demo_shape, report, warm;
} request;

static request read_options(int argc, char **argv)
{
    static const char *const families[] = {"sofas", "planes", "tables", "cars", NULL};
    request r = {0};
    fit_options *o = &r.fit;
    *o = fit_defaults();
    options walk = options_begin(argc, argv, usage);
    int told = 0; /* what the demo's shape is */
    while (option_next(&walk)) {
        if (option_is(&walk, "--start")) {
            r.start = option_text(&walk);
        } else if (option_is(&walk, "--demo")) {
            r.demo = option_flag(&walk);
        } else if (option_is(&walk, "--demo-family")) {
            r.demo_family = SHAPE_SOFA + option_choice(&walk, families);
            told = 1;
        } else if (option_is(&walk, "--demo-shape")) {
            r.demo_shape = option_int(&walk, 0, 1000000);
            told = 1;
        } else if (option_is(&walk, "--warm")) {
            r.warm = option_flag(&walk);
        } else if (option_is(&walk, "--report")) {
            r.report = option_flag(&walk);
        } else if (!option_fit(&walk, o)) {
            option_unknown(&walk);
        }
    }
    if (told && !r.demo) { fail("--demo-family and --demo-shape say what --demo sees; without it they mean nothing"); }
    if (r.demo && (o->depth_path || o->target || o->mask_path)) {
        fail("--demo sees its own shape; leave out --target, --depth and --mask");
    }
    if (!r.demo && !o->depth_path && !o->target) { o->target = "0"; }
    check_fit_options(o);
    option_belongs(r.warm && (o->how.trace == DIST_TRACE_PAPER || o->no_mask || !(o->weights[1] > 0.0f)), "--warm",
                   "starts the guarded tracer's pictures, those with a silhouette");
    if (!o->out && !r.demo) { fail("--out STEM is needed: where the results go"); }
    if (r.demo && o->keep >= 100.0 && !o->points) { o->keep = 5.0; }
    if (!o->out) { o->out = "out/demo"; }
    if (!o->model) { o->model = "embedded"; }
    if (!r.start) { r.start = r.demo ? "mean" : "zero"; }
    check_stem(o->out);
    return r;
}

/* The depth image to be explained, its camera and, where the true shape is known, points on its surface. */
static observation observe(dist_context *ctx, const dist_net *net, request *r, dist_camera *camera, float **points)
{
    fit_options *o = &r->fit;
    observation seen;
    dist_mesh *mesh = NULL;
    *points = NULL;
    if (o->depth_path) {
        seen = observe_file(ctx, o);
        *camera = view_camera(&o->view, 0.0f);
        observe_mask(ctx, o->mask_path, &seen);
        return seen;
    }
    if (!o->view.width) { o->view.width = o->view.height = 128; }
    *camera = view_camera(&o->view, 0.0f);
    if (r->demo) {
        shape truth;
        shape_make(&truth, r->demo_family, SHAPE_HELD_OUT + (unsigned)r->demo_shape);
        dist_field field = shape_field(&truth);
        seen = observe_field(ctx, &field, camera);
        mesh = surface_of(ctx, &field, points);
    } else {
        float *code = choose_code(net, o->target);
        dist_shape *truth = dist_shape_create(ctx, net, code);
        dist_field field = dist_shape_field(truth);
        seen = observe_field(ctx, &field, camera);
        mesh = surface_of(ctx, &field, points);
        dist_shape_destroy(truth);
        free(code);
    }
    dist_mesh_destroy(mesh);
    observe_mask(ctx, o->mask_path, &seen);
    return seen;
}

int main(int argc, char **argv)
{
    request r = read_options(argc, argv);
    size_t bytes = 0;
    if (r.report) { r.fit.settings.allocator = counting_allocator(&bytes); }
    dist_context *ctx = dist_context_create(&r.fit.settings);
    dist_net *net = load_model(ctx, r.fit.model);
    if (dist_net_code_size(net) == 0) { fail("%s has no code, so there is nothing to fit", r.fit.model); }
    float *code = choose_code(net, r.start);
    dist_camera camera;
    float *target_points = NULL;
    observation seen = observe(ctx, net, &r, &camera, &target_points);
    observation_keep(&seen, r.fit.keep, r.fit.points, (unsigned)r.fit.seed);

    fit f = fit_create(ctx, net, &r.fit, &camera, &seen, code, r.report, r.warm);
    fit_and_report(&f, target_points, &bytes);

    fit_destroy(&f);
    observation_destroy(&seen);
    free(target_points);
    free(code);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
