/* SPDX-License-Identifier: MIT-0
   render.c - pictures of a model.   cc -O2 examples/render.c -lm -o render && ./render embedded --out out/shape */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"

static const char usage[] =
    "render MODEL [options] --out STEM\n"
    "  MODEL              a safetensors file, or the word embedded\n"
    "  --code FILE|INDEX  which shape: a stored code (default 0), or numbers as text or .f32\n" VIEW_USAGE
    "  --planes LIST      of depth,normal,silhouette,mask,color (default depth,normal,mask and color if there is one)\n"
    "  --trace WHICH      guarded (default) or paper\n"
    "  --epsilon E        largest |f| of a hit (default: the tracer's)\n"
    "  --alpha A          length of a step relative to |f| (default: the tracer's)\n"
    "  --steps N          queries per ray at most (default: the tracer's)\n"
    "  --threads N        threads to use at most (default all)\n"
    "  --turntable N      N shaded frames around the vertical axis and one sheet of them, in place of the planes\n"
    "  --out STEM         files written: STEM_depth.pfm, STEM_depth.png, STEM_shaded.png ..., STEM.json\n";

enum { DEPTH = 1, NORMAL = 2, SILHOUETTE = 4, MASK = 8, COLOR = 16 };

typedef struct job {
    const char *model, *code, *out;
    view view;
    int planes, frames;
    dist_render_desc how;
    dist_context_desc settings;
} job;

/* A comma list of planes as bits. */
static int option_planes(options *o)
{
    static const char *const names[] = {"depth", "normal", "silhouette", "mask", "color"};
    const char *text = option_text(o);
    int planes = 0;
    for (const char *at = text; *at; at += *at == ',') {
        size_t length = strcspn(at, ",");
        int found = 0;
        for (int i = 0; i < 5; i++) {
            if (length == strlen(names[i]) && strncmp(at, names[i], length) == 0) { found = 1 << i; }
        }
        if (!found) { fail("--planes needs some of depth,normal,silhouette,mask,color, got \"%s\"", text); }
        planes |= found;
        at += length;
    }
    return planes;
}

static job read_options(int argc, char **argv)
{
    static const char *const tracers[] = {"guarded", "paper", NULL};
    job j;
    memset(&j, 0, sizeof j);
    j.view = view_default(512, 512);
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is_word(&o) && !j.model) {
            j.model = o.argv[o.index];
        } else if (option_is(&o, "--code")) {
            j.code = option_text(&o);
        } else if (option_is(&o, "--planes")) {
            j.planes = option_planes(&o);
        } else if (option_is(&o, "--trace")) {
            j.how.trace = option_choice(&o, tracers) ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        } else if (option_is(&o, "--epsilon")) {
            j.how.epsilon = (float)option_number(&o, 1e-9, 1.0);
        } else if (option_is(&o, "--alpha")) {
            j.how.step_scale = (float)option_number(&o, 0.01, 10.0);
        } else if (option_is(&o, "--steps")) {
            j.how.max_steps = option_int(&o, 1, 100000);
        } else if (option_is(&o, "--threads")) {
            j.settings.workers = option_int(&o, 1, 1024);
        } else if (option_is(&o, "--turntable")) {
            j.frames = option_int(&o, 1, 3600);
        } else if (option_is(&o, "--out")) {
            j.out = option_text(&o);
        } else if (!option_view(&o, &j.view)) {
            option_unknown(&o);
        }
    }
    if (!j.model) { fail("which model? render MODEL --out STEM; --help tells more"); }
    if (!j.out) { fail("--out STEM is needed: where the pictures go"); }
    check_stem(j.out);
    return j;
}

/* STEM_name.png, and STEM_name.pfm when there are numbers to keep. */
static void write_plane(dist_context *ctx, const job *j, const char *name, canvas picture, int channels,
                        const float *numbers)
{
    char path[PATH_SIZE];
    char stem[PATH_SIZE];
    path_of(path, j->out, "_");
    path_of(stem, path, name);
    printf("%s\n", write_canvas(stem, &picture));
    if (numbers) {
        dist_pfm_save(ctx, path_of(path, stem, ".pfm"), j->view.width, j->view.height, channels, numbers);
        check(ctx);
        printf("%s\n", path);
    }
}

static void write_planes(dist_context *ctx, const job *j, const dist_images *out)
{
    int w = j->view.width;
    int h = j->view.height;
    size_t n = (size_t)w * (size_t)h;
    if (j->planes & DEPTH) {
        float range[2];
        depth_range(n, out->depth, out->mask, range);
        for (size_t i = 0; i < n; i++) {
            if (!out->mask[i]) { out->depth[i] = 0.0f; } /* the file has no mask beside it */
        }
        write_plane(ctx, j, "depth", picture_depth(w, h, out->depth, out->mask, range[0], range[1]), 1, out->depth);
    }
    if (j->planes & NORMAL) {
        write_plane(ctx, j, "normal", picture_normal(w, h, out->normal, out->mask), 3, out->normal);
        write_plane(ctx, j, "shaded", picture_shaded(w, h, out->normal, out->mask, out->color), 1, NULL);
    }
    if (j->planes & SILHOUETTE) {
        write_plane(ctx, j, "silhouette", picture_gray(w, h, out->silhouette, 0.0f, 0.5f), 1, out->silhouette);
    }
    if (j->planes & MASK) {
        float *numbers = take_floats(n);
        for (size_t i = 0; i < n; i++) {
            numbers[i] = (float)out->mask[i];
        }
        write_plane(ctx, j, "mask", picture_mask(w, h, out->mask), 1, numbers);
        free(numbers);
    }
    if (j->planes & COLOR) { write_plane(ctx, j, "color", picture_color(w, h, out->color), 3, out->color); }
}

static void write_report(const job *j, dist_context *ctx, const dist_camera *camera, const dist_stats *stats,
                         double seconds)
{
    char path[PATH_SIZE];
    json report = json_open(path_of(path, j->out, ".json"));
    dist_render_desc how = dist_render_desc_resolve(&j->how);
    json_text(&report, "model", j->model);
    json_text(&report, "code", j->code ? j->code : "0");
    json_text(&report, "trace", how.trace == DIST_TRACE_PAPER ? "paper" : "guarded");
    json_count(&report, "steps", (unsigned long long)how.max_steps);
    json_number(&report, "alpha", (double)how.step_scale);
    json_text(&report, "isa", dist_isa_name(dist_context_isa(ctx)));
    json_count(&report, "threads", (unsigned long long)dist_context_workers(ctx));
    json_count(&report, "frames", (unsigned long long)(j->frames ? j->frames : 1));
    json_number(&report, "seconds", seconds);
    json_count(&report, "queries", stats->queries);
    json_count(&report, "hits", stats->hits);
    json_camera(&report, "camera", camera);
    json_stats(&report, "stats", stats);
    json_close(&report);
    printf("%s\n%llu queries, %llu hits, %.3f seconds\n", path, stats->queries, stats->hits, seconds);
}

/* One picture a turn's share, shaded only, then all of them on one sheet. */
static void turn(dist_context *ctx, const dist_field *field, const job *j, dist_images *out)
{
    canvas *frames = (canvas *)take((size_t)j->frames, sizeof *frames);
    dist_camera camera = view_camera(&j->view, 0.0f);
    dist_stats total;
    memset(&total, 0, sizeof total);
    double seconds = 0;
    progress p = progress_begin("turntable");
    for (int i = 0; i < j->frames; i++) {
        dist_camera turned = view_camera(&j->view, 2.0f * PI * (float)i / (float)j->frames);
        double start = seconds_now();
        dist_render(ctx, field, &turned, &j->how, out, NULL);
        seconds += seconds_now() - start;
        check(ctx);
        add_stats(&total, out->stats);
        frames[i] = picture_shaded(j->view.width, j->view.height, out->normal, out->mask, out->color);
        char number[16];
        char stem[PATH_SIZE];
        snprintf(number, sizeof number, "_%03d", i);
        write_picture(path_of(stem, j->out, number), frames[i].width, frames[i].height, frames[i].rgb);
        progress_show(&p, i + 1, j->frames, NULL, 0);
    }
    progress_end(&p);
    int columns = (int)ceil(sqrt(1.5 * j->frames));
    canvas sheet = picture_sheet(j->frames, frames, NULL, columns < j->frames ? columns : j->frames);
    char stem[PATH_SIZE];
    printf("%s\n", write_canvas(path_of(stem, j->out, "_sheet"), &sheet));
    for (int i = 0; i < j->frames; i++) {
        canvas_destroy(&frames[i]);
    }
    free(frames);
    write_report(j, ctx, &camera, &total, seconds);
}

static void render(dist_context *ctx, const dist_field *field, const job *j, dist_images *out)
{
    dist_camera camera = view_camera(&j->view, 0.0f);
    double start = seconds_now();
    dist_render(ctx, field, &camera, &j->how, out, NULL);
    double seconds = seconds_now() - start;
    check(ctx);
    write_planes(ctx, j, out);
    write_report(j, ctx, &camera, out->stats, seconds);
}

int main(int argc, char **argv)
{
    job j = read_options(argc, argv);
    dist_context *ctx = dist_context_create(&j.settings);
    dist_net *net = load_model(ctx, j.model);
    float *code = choose_code(net, j.code);
    dist_shape *shape = dist_shape_create(ctx, net, code);
    dist_field field = dist_shape_field(shape);
    check(ctx);

    if (!field.eval_fn) { fail("%s has no distance among its channels, so there is no surface to see", j.model); }
    if (j.planes & COLOR && !field.color_fn) { fail("%s has no color, so --planes cannot have it", j.model); }
    if (!j.planes || j.frames) { j.planes = DEPTH | NORMAL | MASK | (field.color_fn ? COLOR : 0); }
    size_t n = (size_t)j.view.width * (size_t)j.view.height;
    dist_stats stats;
    dist_images out;
    memset(&stats, 0, sizeof stats);
    memset(&out, 0, sizeof out);
    out.stats = &stats;
    out.mask = (unsigned char *)take(n, 1);
    if (j.planes & DEPTH && !j.frames) { out.depth = take_floats(n); }
    if (j.planes & NORMAL) { out.normal = take_floats(3 * n); }
    if (j.planes & SILHOUETTE) { out.silhouette = take_floats(n); }
    if (j.planes & COLOR) { out.color = take_floats(3 * n); }
    if (j.frames) {
        turn(ctx, &field, &j, &out);
    } else {
        render(ctx, &field, &j, &out);
    }

    free(out.mask);
    free(out.depth);
    free(out.normal);
    free(out.silhouette);
    free(out.color);
    free(code);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
