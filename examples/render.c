/* SPDX-License-Identifier: MIT-0
   render.c - pictures of a model.   cc -O2 examples/render.c -lm -o render && ./render embedded --out out/shape
   In color and under lights:  ./render embedded --texture embedded --light -1,1,1 --shadow --out out/shape */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#define COMMON_TEXTURE
#include "common.h"
#include "light.h"

static const char usage[] =
    "render MODEL [options] --out STEM\n"
    "  MODEL              a safetensors file, or the word embedded\n"
    "  --code FILE|INDEX  which shape: a stored code (default 0), or numbers as text or .f32\n" VIEW_USAGE
    "  --texture FILE     colors by a second net; the word embedded: the one made for the embedded model\n"
    "  --color-code WHICH which coloring: a stored one (default 0), or numbers as text or .f32\n"
    "  --planes LIST      of depth,normal,silhouette,mask,color (default depth,normal,mask and color if there is one)\n"
    "  --trace WHICH      guarded (default), certified (proven steps alone, mostly up to ten times the queries) or "
    "paper\n"
    "  --epsilon E        largest |f| of a hit (default: the tracer's)\n"
    "  --alpha A          length of a step relative to |f| (default: the tracer's)\n"
    "  --steps N          queries per ray at most (default: the tracer's)\n"
    "  --normal-delta D   normals by differences over D to either side, which smooths facets (default analytic)\n"
    "  --threads N        threads to use at most (default all)\n"
    "  --turntable N      N shaded frames around the vertical axis and one sheet of them, in place of the planes\n"
    "  --relight N        N more pictures of the same planes, the lights carried around the shape, and one sheet of "
    "them\n"
    "  --zoom N           beside the planes, 1/N of the picture seen N times as large: its pixels, and rendered anew\n"
    "  --zoom-at X,Y      pixel in the middle of that (default the picture's)\n"
    "  --samples-per-pixel N    N x N rays a pixel in shaded pictures (default 1)\n"
    "  --light X,Y,Z[,R,G,B]    a light from there, as seen from the camera: right, up, back; repeat for more. Lit\n"
    "                     pictures take the place of shaded ones (default of the options below: two lamps)\n"
    "  --shadow           lights cast shadows\n"
    "  --ambient-occlusion N    light from everywhere, as far as N rays from each point meet nothing (16 is rough)\n"
    "  --ambient A        how much light comes from everywhere (default 0.3)\n"
    "  --shine S          strength of highlights (default 0)\n"
    REPORT_USAGE
    "  --out STEM         files written: STEM_depth.pfm, STEM_depth.png, STEM_shaded.png ..., STEM.json\n";

enum { DEPTH = 1, NORMAL = 2, SILHOUETTE = 4, MASK = 8, COLOR = 16, DISTANCE = 32, ERROR = 64 };

typedef struct job {
    const char *model, *code, *texture, *color_code, *out;
    view view;
    int planes, frames, relit, samples, zoom, zoom_at_given;
    float zoom_at[2];
    lighting lighting;
    int lit, report;
    dist_render_desc how;
    dist_context_desc settings;
} job;

/* A comma list of planes as bits. */
static int option_planes(options *o)
{
    static const char *const names[] = {"depth", "normal", "silhouette", "mask", "color"};
    const char *text = option_text(o);
    int planes = 0;
    for (const char *at = text; at; at = *at ? at + 1 : NULL) {
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

static void option_light(options *o, lighting *how)
{
    const char *text = option_text(o);
    int numbers = 1, given = how->count;
    float x[6] = {0, 0, 0, 0.8f, 0.8f, 0.8f};
    for (const char *c = text; *c; c++) numbers += *c == ',';
    if (given == LIGHTS) { fail("--light: at most %d lights", LIGHTS); }
    o->inlined = text; /* read again, as numbers */
    option_floats(o, numbers == 6 ? 6 : 3, x);
    if (!(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] > 0.0f)) { fail("--light needs a direction other than 0,0,0"); }
    if (x[3] < 0.0f || x[4] < 0.0f || x[5] < 0.0f) { fail("--light: no color below 0, got \"%s\"", text); }
    memcpy(how->lights[given].toward, x, 3 * sizeof(float));
    memcpy(how->lights[given].color, x + 3, 3 * sizeof(float));
    how->count++;
}

/* 1 if the option was about light. */
static int option_lighting(options *o, job *j)
{
    if (option_is(o, "--light")) option_light(o, &j->lighting);
    else if (option_is(o, "--shadow")) j->lighting.shadow = option_flag(o);
    else if (option_is(o, "--ambient-occlusion")) j->lighting.occlusion = option_int(o, 1, 4096);
    else if (option_is(o, "--ambient")) j->lighting.ambient = (float)option_number(o, 0.0, 10.0);
    else if (option_is(o, "--shine")) j->lighting.shine = (float)option_number(o, 0.0, 10.0);
    else return 0;
    j->lit = 1;
    return 1;
}

static job read_options(int argc, char **argv)
{
    static const char *const tracers[] = {"guarded", "certified", "paper", NULL};
    job j;
    memset(&j, 0, sizeof j);
    j.view = view_default(512, 512);
    j.samples = 1;
    j.lighting = lighting_default();
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is_word(&o) && !j.model) {
            j.model = o.argv[o.index];
        } else if (option_is(&o, "--code")) {
            j.code = option_text(&o);
        } else if (option_is(&o, "--texture")) {
            j.texture = option_text(&o);
        } else if (option_is(&o, "--color-code")) {
            j.color_code = option_text(&o);
        } else if (option_is(&o, "--relight")) {
            j.relit = option_int(&o, 1, 3600);
            j.lit = 1;
        } else if (option_is(&o, "--zoom")) {
            j.zoom = option_int(&o, 2, 1024);
        } else if (option_is(&o, "--zoom-at")) {
            option_floats(&o, 2, j.zoom_at);
            j.zoom_at_given = 1;
        } else if (option_is(&o, "--samples-per-pixel")) {
            j.samples = option_int(&o, 1, 16);
        } else if (option_is(&o, "--planes")) {
            j.planes = option_planes(&o);
        } else if (option_is(&o, "--trace")) {
            int which = option_choice(&o, tracers);
            j.how.trace = which == 2 ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
            j.how.certified = which == 1;
        } else if (option_is(&o, "--epsilon")) {
            j.how.epsilon = (float)option_number(&o, 1e-9, 1.0);
        } else if (option_is(&o, "--alpha")) {
            j.how.step_scale = (float)option_number(&o, 0.01, 10.0);
        } else if (option_is(&o, "--steps")) {
            j.how.max_steps = option_int(&o, 1, 60000);
        } else if (option_is(&o, "--normal-delta")) {
            j.how.normal_mode = DIST_NORMAL_DIFFERENCE;
            j.how.normal_delta = (float)option_number(&o, 1e-6, 1.0);
        } else if (option_is(&o, "--threads")) {
            j.settings.workers = option_int(&o, 1, 1024);
        } else if (option_is(&o, "--report")) {
            j.report = option_flag(&o);
        } else if (option_is(&o, "--turntable")) {
            j.frames = option_int(&o, 1, 3600);
        } else if (option_is(&o, "--out")) {
            j.out = option_text(&o);
        } else if (!option_view(&o, &j.view) && !option_lighting(&o, &j)) {
            option_unknown(&o);
        }
    }
    if (j.lit && j.lighting.count == 0) { j.lighting.count = 2; }
    if (j.color_code && !j.texture) { fail("--color-code is of a texture: --texture names it"); }
    option_belongs(j.frames && (j.zoom || j.planes), "--zoom and --planes", "are of one picture, not of --turntable");
    int shaded = !j.planes || j.planes & NORMAL || j.frames || j.lit || j.zoom;
    option_belongs(j.samples > 1 && !shaded, "--samples-per-pixel",
                   "belongs to shaded pictures, and --planes asks for none");
    if (j.zoom_at_given && !j.zoom) { fail("--zoom-at is of --zoom, which is not given"); }
    if (j.zoom_at_given && !(j.zoom_at[0] >= 0.0f && j.zoom_at[0] <= (float)j.view.width && j.zoom_at[1] >= 0.0f &&
                             j.zoom_at[1] <= (float)j.view.height)) {
        fail("--zoom-at %g,%g lies outside the picture", (double)j.zoom_at[0], (double)j.zoom_at[1]);
    }
    if (j.relit && j.frames) { fail("--relight is of one picture, and --turntable asks for %d", j.frames); }
    if (3.0 * j.view.width * j.view.height * j.frames > 2e9) {
        fail("--turntable %d frames of %d by %d pixels make a sheet of more than 2 GB", j.frames, j.view.width,
             j.view.height);
    }
    if (j.report && j.frames) { fail("--report is of one picture, and --turntable asks for %d", j.frames); }
    if (j.zoom > j.view.width || j.zoom > j.view.height) { fail("--zoom %d leaves no pixel of the picture", j.zoom); }
    if (j.view.width * j.samples > 16384 || j.view.height * j.samples > 16384) {
        fail("--samples-per-pixel %d makes the picture larger than 16384 pixels a side", j.samples);
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

static dist_images planes_create(int width, int height, int planes, dist_stats *stats)
{
    size_t n = (size_t)width * (size_t)height;
    dist_images out;
    memset(&out, 0, sizeof out);
    out.stats = stats;
    out.mask = (unsigned char *)take(n, 1);
    if (planes & DEPTH) { out.depth = take_floats(n); }
    if (planes & DISTANCE) { out.distance = take_floats(n); }
    if (planes & ERROR) { out.error = take_floats(n); }
    if (planes & NORMAL) { out.normal = take_floats(3 * n); }
    if (planes & SILHOUETTE) { out.silhouette = take_floats(n); }
    if (planes & COLOR) { out.color = take_floats(3 * n); }
    return out;
}

static void planes_destroy(dist_images *out)
{
    free(out->mask);
    free(out->depth);
    free(out->distance);
    free(out->error);
    free(out->normal);
    free(out->silhouette);
    free(out->color);
}

/* The shaded or lit picture of these planes. */
static canvas shade(dist_context *ctx, const dist_field *field, const job *j, const dist_camera *camera,
                    const dist_images *out)
{
    if (j->lit) { return picture_lit(ctx, field, camera, out, &j->lighting); }
    return picture_shaded(camera->width, camera->height, out->normal, out->mask, out->color);
}

/* Renders what shade needs, samples x samples rays a pixel; adds to stats and seconds. */
static dist_images fine_planes(dist_context *ctx, const dist_field *field, const job *j, const dist_camera *fine,
                               dist_stats *stats, double *seconds)
{
    dist_stats own;
    dist_images out = planes_create(fine->width, fine->height, DISTANCE | NORMAL | (field->color_fn ? COLOR : 0), &own);
    double start = seconds_now();
    dist_render(ctx, field, fine, &j->how, &out, NULL);
    *seconds += seconds_now() - start;
    check(ctx);
    add_stats(stats, &own);
    out.stats = NULL;
    return out;
}

/* The shaded or lit picture. */
static canvas draw(dist_context *ctx, const dist_field *field, const job *j, const dist_camera *camera,
                   dist_stats *stats, double *seconds)
{
    dist_camera fine = zoom_camera(camera, j->samples);
    dist_images out = fine_planes(ctx, field, j, &fine, stats, seconds);
    canvas picture = shade(ctx, field, j, &fine, &out);
    canvas_reduce(&picture, j->samples);
    planes_destroy(&out);
    return picture;
}

/* A part of the picture as its pixels are, and rendered anew: what a shape is like does not end at a resolution. */
static void write_zoom(dist_context *ctx, const dist_field *field, const job *j, const dist_camera *camera,
                       dist_stats *stats, double *seconds)
{
    static const char *const captions[3] = {"whole", "its pixels", "rendered anew"};
    canvas sheet[3];
    dist_camera window = *camera;
    char path[PATH_SIZE];
    window.width = camera->width / j->zoom;
    window.height = camera->height / j->zoom;
    float x = j->zoom_at_given ? j->zoom_at[0] : 0.5f * (float)camera->width;
    float y = j->zoom_at_given ? j->zoom_at[1] : 0.5f * (float)camera->height;
    int left = (int)floorf(x - 0.5f * (float)window.width + 0.5f);
    int top = (int)floorf(y - 0.5f * (float)window.height + 0.5f);
    window.cx -= (float)left;
    window.cy -= (float)top;
    dist_camera large = zoom_camera(&window, j->zoom);
    sheet[0] = draw(ctx, field, j, camera, stats, seconds);
    sheet[1] = draw(ctx, field, j, &window, stats, seconds);
    canvas_enlarge(&sheet[1], j->zoom);
    sheet[2] = draw(ctx, field, j, &large, stats, seconds);
    for (int i = -2; i < window.width + 2; i++) { /* a frame around the part, in the whole */
        canvas_set(&sheet[0], left + i, top - 2, 0.85f, 0.1f, 0.1f);
        canvas_set(&sheet[0], left + i, top + window.height + 1, 0.85f, 0.1f, 0.1f);
    }
    for (int i = -2; i < window.height + 2; i++) {
        canvas_set(&sheet[0], left - 2, top + i, 0.85f, 0.1f, 0.1f);
        canvas_set(&sheet[0], left + window.width + 1, top + i, 0.85f, 0.1f, 0.1f);
    }
    canvas picture = picture_sheet(3, sheet, captions, 3);
    printf("%s\n", write_canvas(path_of(path, j->out, "_zoom"), &picture));
    for (int i = 0; i < 3; i++) canvas_destroy(&sheet[i]);
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
    if (j->texture) { json_text(&report, "texture", j->texture); }
    if (j->texture) { json_text(&report, "color_code", j->color_code ? j->color_code : "0"); }
    json_count(&report, "samples_per_pixel", (unsigned long long)j->samples);
    json_count(&report, "lights", (unsigned long long)(j->lit ? j->lighting.count : 0));
    json_text(&report, "trace", how.trace == DIST_TRACE_PAPER ? "paper" : how.certified ? "certified" : "guarded");
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

/* STEM_000 and so on, then all of them on STEM_sheet. */
static void write_frames(const job *j, int count, canvas *frames, const char *name)
{
    char number[32], stem[PATH_SIZE];
    for (int i = 0; i < count; i++) {
        snprintf(number, sizeof number, "_%s%03d", name, i);
        write_picture(path_of(stem, j->out, number), frames[i].width, frames[i].height, frames[i].rgb);
    }
    int columns = (int)ceil(sqrt(1.5 * count));
    canvas sheet = picture_sheet(count, frames, NULL, columns < count ? columns : count);
    snprintf(number, sizeof number, "_%ssheet", name);
    printf("%s\n", write_canvas(path_of(stem, j->out, number), &sheet));
    for (int i = 0; i < count; i++) {
        canvas_destroy(&frames[i]);
    }
    free(frames);
}

/* The planes are rendered once; only what the lights see is asked of the field again, and that for shadows alone. */
static void relight(dist_context *ctx, const dist_field *field, const job *j, const dist_camera *camera,
                    dist_stats *stats, double *seconds)
{
    dist_camera fine = zoom_camera(camera, j->samples);
    dist_images out = fine_planes(ctx, field, j, &fine, stats, seconds);
    canvas *frames = (canvas *)take((size_t)j->relit, sizeof *frames);
    job turned = *j;
    progress p = progress_begin("relighting");
    for (int i = 0; i < j->relit; i++) {
        float angle = 2.0f * PI * (float)i / (float)j->relit;
        for (int k = 0; k < j->lighting.count; k++) {
            const float *from = j->lighting.lights[k].toward;
            float *to = turned.lighting.lights[k].toward;
            to[0] = cosf(angle) * from[0] + sinf(angle) * from[2];
            to[2] = cosf(angle) * from[2] - sinf(angle) * from[0];
        }
        frames[i] = shade(ctx, field, &turned, &fine, &out);
        canvas_reduce(&frames[i], j->samples);
        progress_show(&p, i + 1, j->relit, NULL, 0);
    }
    progress_end(&p);
    planes_destroy(&out);
    write_frames(j, j->relit, frames, "relit_");
}

/* One picture a turn's share, then all of them on one sheet. */
static void turn(dist_context *ctx, const dist_field *field, const job *j)
{
    canvas *frames = (canvas *)take((size_t)j->frames, sizeof *frames);
    dist_camera camera = view_camera(&j->view, 0.0f);
    dist_stats total;
    memset(&total, 0, sizeof total);
    double seconds = 0;
    progress p = progress_begin("turntable");
    for (int i = 0; i < j->frames; i++) {
        dist_camera turned = view_camera(&j->view, 2.0f * PI * (float)i / (float)j->frames);
        frames[i] = draw(ctx, field, j, &turned, &total, &seconds);
        progress_show(&p, i + 1, j->frames, NULL, 0);
    }
    progress_end(&p);
    write_frames(j, j->frames, frames, "");
    write_report(j, ctx, &camera, &total, seconds);
}

/* bytes: what the context's allocator has given. */
static void render(dist_context *ctx, const dist_field *field, const job *j, const size_t *bytes)
{
    dist_camera camera = view_camera(&j->view, 0.0f);
    dist_stats stats;
    memset(&stats, 0, sizeof stats);
    int extra = j->lit ? DISTANCE | NORMAL | (field->color_fn ? COLOR : 0) : 0;
    if (j->report) { extra |= DISTANCE | ERROR; }
    dist_images out = planes_create(camera.width, camera.height, j->planes | extra, &stats);
    double start = seconds_now();
    dist_render(ctx, field, &camera, &j->how, &out, NULL);
    double seconds = seconds_now() - start;
    check(ctx);
    if (j->report) { print_report(ctx, field, &camera, &j->how, &out, seconds, *bytes); }
    write_planes(ctx, j, &out);
    if (j->planes & NORMAL || j->lit) {
        canvas picture = j->samples == 1 ? shade(ctx, field, j, &camera, &out)
                                         : draw(ctx, field, j, &camera, &stats, &seconds);
        write_plane(ctx, j, j->lit ? "lit" : "shaded", picture, 1, NULL);
    }
    planes_destroy(&out);
    if (j->relit) { relight(ctx, field, j, &camera, &stats, &seconds); }
    if (j->zoom) { write_zoom(ctx, field, j, &camera, &stats, &seconds); }
    write_report(j, ctx, &camera, &stats, seconds);
}

int main(int argc, char **argv)
{
    job j = read_options(argc, argv);
    size_t bytes = 0;
    if (j.report) { j.settings.allocator = counting_allocator(&bytes); }
    dist_context *ctx = dist_context_create(&j.settings);
    dist_net *net = load_model(ctx, j.model);
    dist_net *texture = j.texture ? load_texture(ctx, j.texture) : NULL;
    float *code = choose_code(net, j.code);
    dist_shape *shape = dist_shape_create(ctx, net, code);
    if (texture) {
        float *codes = choose_code(texture, j.color_code); /* the shape's code, then the color's */
        int own = dist_net_code_size(net), both = dist_net_code_size(texture);
        dist_shape_set_texture(shape, texture, codes + (own < both ? own : both));
        free(codes);
    }
    dist_field field = dist_shape_field(shape);
    check(ctx);

    if (!field.eval_fn) { fail("%s has no distance among its channels, so there is no surface to see", j.model); }
    if (j.planes & COLOR && !field.color_fn) { fail("%s has no color, so --planes cannot have it", j.model); }
    if (!j.planes) { j.planes = DEPTH | NORMAL | MASK | (field.color_fn ? COLOR : 0); }
    if (j.frames) {
        turn(ctx, &field, &j);
    } else {
        render(ctx, &field, &j, &bytes);
    }

    free(code);
    dist_shape_destroy(shape);
    dist_net_destroy(texture);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
