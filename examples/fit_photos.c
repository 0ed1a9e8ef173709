/* SPDX-License-Identifier: MIT-0
   fit_photos.c - posed photos in, the shape out: the decoder's code is moved until every photo, warped into its
   neighbor through the rendered depth, looks like it. No mask, no depth and no color of the shape is known.
   cc -O2 examples/fit_photos.c -lm -o fit_photos && ./fit_photos --out out/photos */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#define COMMON_TEXTURE
#include "common.h"
#include "fit.h"
#include "raster.h"

static const char usage[] =
    "fit_photos [MODEL] [--target WHICH | --photos DIR] [options] --out STEM\n"
    "  MODEL              a safetensors file, or the word embedded (default)\n"
    "  --target WHICH     photos are taken of a shape of the model, by INDEX or a code's FILE (default 0)\n"
    "  --photos DIR       or: read DIR/cameras.txt and the PPM or PFM files that it names, one line a photo:\n"
    "                       FILE fx fy cx cy r00 r01 r02 r10 r11 r12 r20 r21 r22 t0 t1 t2\n"
    "                     x_cam = R x + t, x right, y down, z forward, pixel centers at integers, # a comment;\n"
    "                     the shape stands in the unit sphere around 0. Neighbors in the file should be in space\n"
    "  --save DIR         writes the photos that were taken in that form\n"
    "  --texture FILE     what the shape is painted with: the word embedded (default with the embedded model), or\n"
    "                     waves (default without it), a pattern in space\n"
    "  --color-code N     which of the texture's colorings (default 0)\n"
    "  --views N          photos taken (default 24)\n"
    "  --size WxH         of each (default 112x112)\n"
    "  --fov DEGREES      of each, from top to bottom (default 45)\n"
    "  --background WHICH sky (default, a pattern far away) or plain\n"
    "  --batch N          photos a step (default 8)\n"
    "  --start WHICH      random:SEED (default random:1), zero, mean, INDEX or FILE: the code to begin with\n"
    "  --iterations N     steps of Adam (default 64)\n"
    "  --rate R           its rate (default 0.01)\n"
    "  --weights P,C      of the photometric loss and the code prior (default 5,1)\n"
    "  --ssim S           share of structural similarity in the loss, 0 to 1 (default 0)\n"
    "  --blur B           photos are blurred by so many pixels at first, sharp after half of the steps (default 4)\n"
    "  --gradient WHICH   auto (default), implicit, normal, paper, or mesh: the baseline, through a mesh's depth\n"
    "  --mesh-cells N     of that mesh's grid (default 48)\n"
    "  --similarity       scale, rotation and translation of the shape are found as well\n"
    "  --off P,D,T        photos taken: it starts P percent too large or small, turned by D degrees, moved by T\n"
    "                     (default 10,10,0.1)\n"
    "  --place S,X,Y,Z    photos read: the scale and place it starts with (default 1,0,0,0)\n"
    "  --trials N         fits from random:1 to random:N, and how many end at a third of the start's Chamfer or less\n"
    "  --threads N        threads to use at most (default all)\n"
    "  --out STEM         files written: STEM.png, STEM_loss.svg, STEM.ply, STEM.json\n";

enum { GRADIENT_MESH = 4, NEIGHBORS = 2, SHOWN = 4, SCORE_POINTS = 10000 };

typedef struct request {
    const char *model, *target, *texture, *photos, *save, *start, *out;
    int width, height, views, batch, iterations, trials, plain, gradient, cells, color_code, similarity;
    float rate, weights[2], ssim, blur, off[3], place[4], fov;
    dist_context_desc settings;
} request;

/* One photo and what is rendered from its place. */
typedef struct view_data {
    dist_camera camera;
    float *photo, *color; /* as taken; as compared, perhaps blurred */
    float *depth, *d_depth;
    unsigned char *mask;
    float *true_depth; /* of the shape that the photo was taken of; NULL: not known */
    unsigned char *true_mask;
    unsigned *triangle; /* mesh baseline: 1 + the triangle in each pixel, 0 for none */
    dist_tape *tape;
    int neighbor[NEIGHBORS];
    int used; /* in this step */
} view_data;

/* What is looked for. */
typedef struct state {
    float *code;
    dist_similarity place; /* of the shape in the world */
} state;

typedef struct fit {
    const request *asked;
    dist_context *ctx;
    dist_shape *shape;
    dist_scene *scene; /* with --similarity: the shape in its place */
    dist_field field;  /* of the scene or of the shape */
    size_t code_size, view_count;
    view_data *views;
    state now;
    float *d_code; /* and of the placement: code_size + 7 */
    float *target_points; /* on the true surface; NULL: not known */
    dist_render_desc how;
    unsigned long long queries;
    size_t compared; /* pixels that the last loss is a mean over: both photos of a pair show what is there */
} fit;

/* Makes f->field the shape of this code in this place. */
static void fit_set(fit *f, const state *s)
{
    dist_shape_set_code(f->shape, s->code);
    f->field = dist_shape_field(f->shape);
    if (f->scene) {
        dist_field field = f->field;
        dist_instance instance;
        instance.field = &field;
        instance.placement = s->place;
        dist_scene_set(f->scene, 0, &instance);
        f->field = dist_scene_field(f->scene);
    }
    check(f->ctx);
}

static size_t pixel_count(const view_data *v)
{
    return (size_t)v->camera.width * (size_t)v->camera.height;
}

/* ---- photos ------------------------------------------------------------------------------------------------------ */

/* Color of a painted shape at a place on its surface: waves of several lengths, the same from everywhere. */
static void paint(const float p[3], float color[3])
{
    static const float wave[6][4] = {{3.1f, 1.7f, -2.3f, 0.5f}, {-2.2f, 3.4f, 1.9f, 1.9f},  {1.3f, -2.8f, 3.6f, 4.1f},
                                     {9.1f, 5.2f, -6.7f, 2.2f}, {-7.4f, 8.3f, 5.9f, 0.3f}, {6.1f, -9.4f, 7.7f, 3.3f}};
    for (int k = 0; k < 3; k++) {
        const float *a = wave[k];
        const float *b = wave[3 + k];
        color[k] = 0.5f + 0.28f * sinf(a[0] * p[0] + a[1] * p[1] + a[2] * p[2] + a[3]) +
                   0.14f * sinf(b[0] * p[0] + b[1] * p[1] + b[2] * p[2] + b[3]);
    }
}

/* A picture of the field as a camera takes it: in its own colors if it has any. */
static void take_photo(fit *f, const dist_field *field, view_data *v)
{
    size_t n = pixel_count(v);
    size_t width = (size_t)v->camera.width;
    dist_images out;
    memset(&out, 0, sizeof out);
    out.distance = take_floats(n);
    out.depth = v->true_depth = take_floats(n);
    out.mask = v->true_mask = (unsigned char *)take(n, 1);
    out.color = field->color_fn ? v->photo : NULL;
    dist_render(f->ctx, field, &v->camera, NULL, &out, NULL);
    check(f->ctx);
    for (size_t i = 0; i < n; i++) {
        float origin[3];
        float direction[3];
        float p[3];
        dist_camera_ray(&v->camera, (float)(i % width), (float)(i / width), origin, direction);
        for (int k = 0; k < 3; k++) {
            p[k] = out.mask[i] ? origin[k] + out.distance[i] * direction[k] : 1.5f * direction[k];
        }
        float *color = v->photo + 3 * i;
        if (out.mask[i] ? !out.color : !f->asked->plain) { paint(p, color); }
        if (!out.mask[i] && f->asked->plain) { color[0] = color[1] = color[2] = 0.8f; }
    }
    free(out.distance);
}

static void view_take(fit *f, view_data *v, const char *name)
{
    size_t n = pixel_count(v);
    if (!v->photo) { v->photo = take_floats(3 * n); }
    v->color = take_floats(3 * n);
    v->depth = take_floats(n);
    v->d_depth = take_floats(n);
    v->mask = (unsigned char *)take(n, 1);
    v->triangle = (unsigned *)take(n, sizeof *v->triangle);
    v->tape = dist_tape_create(f->ctx, &v->camera, &f->how);
    if (dist_context_status(f->ctx) != DIST_OK) { fail("%s: %s", name, dist_context_message(f->ctx)); }
}

/* Cameras around the shape, higher and lower by turns so that more of it is seen than from one height. */
static void take_photos(fit *f, const dist_field *field)
{
    const request *o = f->asked;
    f->view_count = (size_t)o->views;
    f->views = (view_data *)take(f->view_count, sizeof *f->views);
    for (size_t i = 0; i < f->view_count; i++) {
        view look = view_default(o->width, o->height);
        float turn = 2.0f * PI * (float)i / (float)o->views;
        float rise = (25.0f + 15.0f * sinf(2.0f * turn)) * PI / 180.0f;
        look.eye[0] = 2.4f * cosf(rise);
        look.eye[1] = 2.4f * sinf(rise);
        look.eye[2] = 0.0f;
        look.fov = o->fov;
        f->views[i].camera = view_camera(&look, turn);
        view_take(f, &f->views[i], "a photo");
        take_photo(f, field, &f->views[i]);
    }
}

/* The next number of a PPM's header, over blanks and comments: 0 where there is none from 1 to 16384. */
static int ppm_number(const char **at)
{
    while (**at == '#' || (**at && strchr(" \t\r\n", **at))) { *at += **at == '#' ? strcspn(*at, "\n") : 1; }
    char *end = NULL;
    long number = **at >= '0' && **at <= '9' ? strtol(*at, &end, 10) : 0;
    if (number < 1 || number > 16384) { return 0; }
    *at = end;
    return (int)number;
}

/* A PFM, or a PPM with 8 bits. */
static float *read_photo(dist_context *ctx, const char *path, int *width, int *height)
{
    size_t size = 0;
    int channels = 0;
    float *photo = NULL;
    if (path_ends_with(path, ".pfm")) {
        float *plane = dist_pfm_load(ctx, path, width, height, &channels);
        check(ctx);
        size_t n = (size_t)*width * (size_t)*height;
        photo = take_floats(3 * n);
        for (size_t i = 0; i < 3 * n; i++) { photo[i] = channels == 3 ? plane[i] : plane[i / 3]; }
        dist_pfm_free(ctx, plane, *width, *height, channels);
        return photo;
    }
    unsigned char *bytes = read_file(path, &size);
    const char *at = (const char *)bytes + 2;
    int is_ppm = strncmp((const char *)bytes, "P6", 2) == 0 && (*width = ppm_number(&at)) > 0 &&
                 (*height = ppm_number(&at)) > 0;
    if (!is_ppm || ppm_number(&at) != 255) {
        fail("%s is not a PFM and not a PPM of 8 bits (\"P6 WIDTH HEIGHT 255\", sides of 1 to 16384)", path);
    }
    size_t n = 3 * (size_t)*width * (size_t)*height;
    size_t used = (size_t)(at - (const char *)bytes) + 1; /* one blank ends the header */
    if (size < used + n) { fail("%s is cut off", path); }
    photo = take_floats(n);
    for (size_t i = 0; i < n; i++) { photo[i] = (float)bytes[used + i] / 255.0f; }
    free(bytes);
    return photo;
}

static void read_photos(fit *f)
{
    char path[PATH_SIZE];
    char file[PATH_SIZE];
    char name[257] = "/";
    size_t size = 0;
    char *text = (char *)read_file(path_of(path, f->asked->photos, "/cameras.txt"), &size);
    for (char *line = text; line && *line; line = strchr(line, '\n') ? strchr(line, '\n') + 1 : NULL) {
        view_data v;
        float number[16];
        int used = 0;
        char *at = line + strspn(line, " \t\r");
        if (*at == '#' || *at == '\n' || !*at) { continue; }
        memset(&v, 0, sizeof v);
        if (sscanf(at, "%255s%n", name + 1, &used) != 1) { continue; }
        at += used;
        for (int k = 0; k < 16; k++) {
            char *end = at;
            number[k] = (float)strtod(at, &end);
            if (end == at || memchr(at, '\n', (size_t)(end - at))) { fail("%s: %s needs 16 numbers", path, name + 1); }
            at = end;
        }
        v.camera.fx = number[0];
        v.camera.fy = number[1];
        v.camera.cx = number[2];
        v.camera.cy = number[3];
        memcpy(v.camera.rotation, number + 4, sizeof v.camera.rotation);
        memcpy(v.camera.translation, number + 13, sizeof v.camera.translation);
        v.photo = read_photo(f->ctx, path_of(file, f->asked->photos, name), &v.camera.width, &v.camera.height);
        f->views = (view_data *)realloc(f->views, (f->view_count + 1) * sizeof v);
        if (!f->views) { fail("out of memory"); }
        f->views[f->view_count] = v;
        view_take(f, &f->views[f->view_count++], name + 1);
    }
    free(text);
    if (f->view_count < 2) { fail("%s names %.0f photos; two are needed", path, (double)f->view_count); }
}

static void save_photos(const fit *f)
{
    char path[PATH_SIZE];
    make_folders(path_of(path, f->asked->save, "/cameras.txt"));
    FILE *list = open_file(path, "wb");
    fputs("# FILE fx fy cx cy R (row by row) t; x_cam = R x + t, pixel centers at integers\n", list);
    for (size_t i = 0; i < f->view_count; i++) {
        const view_data *v = &f->views[i];
        const dist_camera *c = &v->camera;
        char name[64];
        char ending[80];
        char photo_path[PATH_SIZE];
        snprintf(name, sizeof name, "%03.0f.ppm", (double)i);
        snprintf(ending, sizeof ending, "/%s", name);
        fprintf(list, "%s %.9g %.9g %.9g %.9g", name, (double)c->fx, (double)c->fy, (double)c->cx, (double)c->cy);
        for (int k = 0; k < 12; k++) {
            fprintf(list, " %.9g", (double)(k < 9 ? c->rotation[k] : c->translation[k - 9]));
        }
        fputc('\n', list);
        canvas picture = picture_color(c->width, c->height, v->photo);
        FILE *file = open_file(path_of(photo_path, f->asked->save, ending), "wb");
        fprintf(file, "P6\n%d %d\n255\n", c->width, c->height);
        fwrite(picture.rgb, 3, pixel_count(v), file);
        close_file(file, photo_path);
        canvas_destroy(&picture);
    }
    close_file(list, path);
}

/* Gaussian blur with clamped rim. */
static void blur(int width, int height, const float *from, float sigma, float *to)
{
    int reach = (int)ceilf(2.5f * sigma);
    float weights[64];
    float *between = take_floats(3 * (size_t)width * (size_t)height);
    float sum = 0;
    reach = reach > 31 ? 31 : reach;
    for (int k = -reach; k <= reach; k++) {
        weights[k + reach] = sigma > 0 ? expf(-0.5f * (float)(k * k) / (sigma * sigma)) : 1.0f;
        sum += weights[k + reach];
    }
    for (int pass = 0; pass < 2; pass++) {
        const float *source = pass ? between : from;
        float *target = pass ? to : between;
        for (int i = 0; i < width * height; i++) {
            int x = i % width;
            int y = i / width;
            float value[3] = {0, 0, 0};
            for (int k = -reach; k <= reach; k++) {
                int u = pass ? x : x + k;
                int v = pass ? y + k : y;
                u = u < 0 ? 0 : u >= width ? width - 1 : u;
                v = v < 0 ? 0 : v >= height ? height - 1 : v;
                for (int c = 0; c < 3; c++) {
                    value[c] += weights[k + reach] / sum * source[3 * (v * width + u) + c];
                }
            }
            memcpy(target + 3 * i, value, sizeof value);
        }
    }
    free(between);
}

/* The two nearest photos that look the same way; of two photos the other one, twice. */
static void find_neighbors(fit *f)
{
    for (size_t i = 0; i < f->view_count; i++) {
        view_data *v = &f->views[i];
        double best[NEIGHBORS] = {1e30, 1e30};
        for (int k = 0; k < NEIGHBORS; k++) { v->neighbor[k] = -1; }
        for (size_t j = 0; j < f->view_count; j++) {
            const dist_camera *a = &v->camera;
            const dist_camera *b = &f->views[j].camera;
            float eye[2][3];
            float direction[3];
            double along = 0;
            double distance = 0;
            if (i == j) { continue; }
            dist_camera_ray(a, 0, 0, eye[0], direction);
            dist_camera_ray(b, 0, 0, eye[1], direction);
            for (int k = 0; k < 3; k++) {
                along += (double)a->rotation[6 + k] * (double)b->rotation[6 + k];
                distance += ((double)eye[0][k] - (double)eye[1][k]) * ((double)eye[0][k] - (double)eye[1][k]);
            }
            distance += along > 0.5 ? 0 : 1e6;
            for (int k = 0; k < NEIGHBORS; k++) {
                if (v->neighbor[k] >= 0 && distance >= best[k]) { continue; }
                for (int m = NEIGHBORS - 1; m > k; m--) {
                    best[m] = best[m - 1];
                    v->neighbor[m] = v->neighbor[m - 1];
                }
                best[k] = distance;
                v->neighbor[k] = (int)j;
                break;
            }
        }
        for (int k = 1; k < NEIGHBORS; k++) {
            if (v->neighbor[k] < 0) { v->neighbor[k] = v->neighbor[k - 1]; }
        }
    }
}

/* ---- loss -------------------------------------------------------------------------------------------------------- */

static dist_photo photo_of(const view_data *v)
{
    dist_photo photo;
    photo.color = v->color;
    photo.depth = v->depth;
    photo.mask = v->mask;
    photo.camera = v->camera;
    return photo;
}

/* The pairs of a step: places spread evenly over the sequence, which move on from step to step, each with one of its
   neighbors. Returns their number. */
static int choose_pairs(const fit *f, int step, int (*pairs)[2])
{
    int n = (int)f->view_count;
    int count = f->asked->batch / 2 < n / 2 ? f->asked->batch / 2 : n / 2;
    int stride = n / count;
    for (int k = 0; k < count; k++) {
        int i = (step % stride + k * n / count) % n;
        pairs[k][0] = i;
        pairs[k][1] = f->views[i].neighbor[step / stride % NEIGHBORS];
    }
    return count;
}

/* Depth of all views in use, by rays or by the mesh. */
static void render_views(fit *f, const dist_mesh *mesh)
{
    for (size_t i = 0; i < f->view_count; i++) {
        view_data *v = &f->views[i];
        if (!v->used) { continue; }
        memset(v->d_depth, 0, pixel_count(v) * sizeof(float));
        if (mesh) {
            raster_depth(&v->camera, mesh, v->depth, v->mask, v->triangle);
            continue;
        }
        dist_stats stats;
        dist_images out;
        memset(&stats, 0, sizeof stats);
        memset(&out, 0, sizeof out);
        out.depth = v->depth;
        out.mask = v->mask;
        out.stats = &stats;
        dist_render(f->ctx, &f->field, &v->camera, &f->how, &out, v->tape);
        check(f->ctx);
        f->queries += stats.queries;
    }
}

/* From the depths' gradients to the code's. */
static void views_backward(fit *f, const dist_mesh *mesh)
{
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = f->d_code;
    float *d_vertices = mesh ? take_floats(3 * mesh->vertex_count) : NULL;
    for (size_t i = 0; i < f->view_count; i++) {
        view_data *v = &f->views[i];
        dist_images d_out;
        if (!v->used) { continue; }
        memset(&d_out, 0, sizeof d_out);
        d_out.depth = v->d_depth;
        if (mesh) { raster_backward(&v->camera, mesh, v->triangle, v->d_depth, d_vertices); }
        if (!mesh) { dist_render_backward(f->ctx, v->tape, &d_out, &grads); }
    }
    if (mesh) { dist_mesh_backward(f->ctx, &f->field, mesh, d_vertices, &grads); }
    check(f->ctx);
    free(d_vertices);
}

/* Photometric loss, both ways of each pair, and the code prior (its mean of squares, as in the authors' code). */
static double fit_loss(fit *f, int count, int (*pairs)[2], double terms[2])
{
    const request *o = f->asked;
    dist_photometric_desc desc;
    dist_mesh *mesh = NULL;
    memset(&desc, 0, sizeof desc);
    desc.ssim = o->ssim;
    f->compared = 0;
    memset(f->d_code, 0, (f->code_size + 7) * sizeof(float));
    for (size_t i = 0; i < f->view_count; i++) { f->views[i].used = 0; }
    for (int k = 0; k < count; k++) { f->views[pairs[k][0]].used = f->views[pairs[k][1]].used = 1; }
    fit_set(f, &f->now);
    if (o->gradient == GRADIENT_MESH) {
        dist_mesh_desc how;
        memset(&how, 0, sizeof how);
        how.resolution = o->cells;
        mesh = dist_mesh_extract(f->ctx, &f->field, &how);
        check(f->ctx);
    }
    render_views(f, mesh);
    terms[0] = 0;
    for (int k = 0; k < 2 * count; k++) {
        view_data *v = &f->views[pairs[k / 2][k % 2]];
        dist_photo to = photo_of(v);
        dist_photo from = photo_of(&f->views[pairs[k / 2][1 - k % 2]]);
        desc.visible = (unsigned char *)take(pixel_count(v), 1);
        terms[0] += (double)dist_loss_photometric(&to, &from, &desc, o->weights[0] / (float)(2 * count), v->d_depth,
                                                  NULL);
        for (size_t i = 0; i < pixel_count(v); i++) { f->compared += desc.visible[i]; }
        free(desc.visible);
    }
    views_backward(f, mesh);
    dist_mesh_destroy(mesh);
    terms[1] = (double)dist_loss_code(f->code_size, f->now.code, o->weights[1] / (float)f->code_size, f->d_code);
    return terms[0] + terms[1];
}

static void blur_photos(fit *f, float sigma)
{
    for (size_t i = 0; i < f->view_count; i++) {
        view_data *v = &f->views[i];
        blur(v->camera.width, v->camera.height, v->photo, sigma, v->color);
    }
}

/* A step too long can blow a placement up, or shrink it to nothing: farther than this no photo shows it. */
static int has_gone_astray(const dist_similarity *now, const dist_similarity *start)
{
    double times = (double)now->scale / (double)start->scale;
    double square = 0;
    for (int k = 0; k < 3; k++) {
        double away = ((double)now->translation[k] - (double)start->translation[k]) / (double)start->scale;
        square += away * away;
    }
    return !(times > 1e-4 && times < 1e4 && square < 1e8);
}

/* loss: (iterations, 3), total and terms. The blur goes down in four stages: far from the truth only what is broad in
   the photos tells where to go. */
static void fit_run(fit *f, double *loss)
{
    const request *o = f->asked;
    float moments[14] = {0};
    dist_adam adam;
    dist_adam mover;
    memset(&adam, 0, sizeof adam);
    memset(&mover, 0, sizeof mover);
    adam.rate = o->rate;
    adam.moments = take_floats(2 * f->code_size);
    mover.rate = 0.5f * o->rate;
    mover.moments = moments;
    int(*pairs)[2] = (int(*)[2])take(f->view_count, sizeof *pairs);
    progress p = progress_begin("fitting");
    dist_similarity start = f->now.place;
    int stage = -1;
    int astray = 0;
    for (int i = 0; i < o->iterations; i++) {
        int now = 8 * i / o->iterations < 4 ? 8 * i / o->iterations : 4;
        if (now != stage) { blur_photos(f, o->blur * (float)(4 - now) / 4.0f); }
        stage = now;
        int count = choose_pairs(f, i, pairs);
        loss[3 * i] = fit_loss(f, count, pairs, loss + 3 * i + 1);
        dist_adam_step(&adam, f->code_size, f->now.code, f->d_code);
        if (f->scene && !astray) {
            float step[7] = {0};
            dist_similarity last = f->now.place;
            dist_adam_step(&mover, 7, step, f->d_code + f->code_size);
            dist_similarity_move(&f->now.place, step);
            if (has_gone_astray(&f->now.place, &start)) {
                f->now.place = last;
                astray = i + 1;
            }
        }
        progress_show(&p, i + 1, o->iterations, "loss", loss[3 * i]);
    }
    progress_end(&p);
    if (astray) { printf("the placement has gone astray at step %d and stays where it was before\n", astray); }
    free(pairs);
    free(adam.moments);
}

/* Sharp photos, every view with its nearest neighbor, and Chamfer distance from the truth to the shape as in the paper
   (squared; below 0: not known). The depths of all views are left in place. */
static score fit_score(fit *f)
{
    double terms[2];
    agreement seen = {0, 0, 0, 0};
    int(*pairs)[2] = (int(*)[2])take(f->view_count, sizeof *pairs);
    for (size_t i = 0; i < f->view_count; i++) {
        pairs[i][0] = (int)i;
        pairs[i][1] = f->views[i].neighbor[0];
    }
    blur_photos(f, 0.0f);
    double loss = fit_loss(f, (int)f->view_count, pairs, terms);
    free(pairs);
    for (size_t i = 0; i < f->view_count; i++) {
        const view_data *v = &f->views[i];
        if (v->true_depth) { agreement_add(&seen, pixel_count(v), v->true_depth, v->true_mask, v->depth, v->mask); }
    }
    score s = agreement_score(&seen);
    s.loss = loss;
    if (f->target_points) {
        float *points = NULL;
        double both = 0;
        double one_way[2];
        dist_mesh *mesh = surface_of(f->ctx, &f->field, &points);
        dist_mesh_destroy(mesh);
        if (points) {
            dist_chamfer(f->ctx, SCORE_POINTS, f->target_points, SCORE_POINTS, points, &both, one_way);
            check(f->ctx);
            s.chamfer = one_way[0];
        }
        free(points);
    }
    return s;
}

/* How far the placement is from the true one, which is none: percent of scale, degrees, distance. */
static void place_error(const dist_similarity *s, float error[3])
{
    float cosine = 0.5f * (s->rotation[0] + s->rotation[4] + s->rotation[8] - 1.0f);
    const float *t = s->translation;
    error[0] = 100.0f * fabsf(s->scale - 1.0f);
    error[1] = acosf(cosine > 1.0f ? 1.0f : cosine < -1.0f ? -1.0f : cosine) * 180.0f / PI;
    error[2] = sqrtf(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]);
}

/* Where a fit starts: as the user says; or, with photos that were taken, off by chance. */
static dist_similarity start_place(const request *o, int trial)
{
    rng r = rng_begin(1000u + (unsigned)trial);
    dist_similarity place;
    float step[7];
    float axis[6];
    memset(&place, 0, sizeof place);
    for (int k = 0; k < 6; k++) { axis[k] = rng_normal(&r); }
    float turn = o->off[1] * PI / 180.0f / sqrtf(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
    float shift = o->off[2] / sqrtf(axis[3] * axis[3] + axis[4] * axis[4] + axis[5] * axis[5]);
    step[0] = logf(1.0f + (rng_uniform(&r) < 0.5f ? -0.01f : 0.01f) * o->off[0]);
    for (int k = 0; k < 6; k++) { step[1 + k] = axis[k] * (k < 3 ? turn : shift); }
    if (o->photos || !o->similarity) {
        memset(step, 0, sizeof step);
        step[0] = logf(o->place[0]);
        memcpy(step + 4, o->place + 1, 3 * sizeof(float));
    }
    dist_similarity_move(&place, step);
    return place;
}

/* ---- report ------------------------------------------------------------------------------------------------------ */

/* Four views in a row each: photos, start, result, truth if known, and what the neighbors' photos say is there. */
static void write_sheet(fit *f, const state *start, const state *target)
{
    enum { ROWS = 5 };
    static const char *const names[ROWS] = {"photo", "start", "result", "truth", "neighbor warped"};
    canvas pictures[ROWS * SHOWN];
    const char *captions[ROWS * SHOWN];
    int count = 0;
    for (int row = 0; row < ROWS; row++) {
        if (row == 3 && !target->code) { continue; }
        fit_set(f, row == 1 ? start : row == 3 ? target : &f->now);
        for (int k = 0; k < SHOWN; k++) {
            view_data *v = &f->views[(size_t)k * f->view_count / SHOWN];
            int zoom = picture_zoom(v->camera.width, v->camera.height);
            canvas *picture = &pictures[count];
            captions[count++] = names[row];
            if (row == 1 || row == 2 || row == 3) {
                *picture = picture_field(f->ctx, &f->field, &v->camera);
                continue;
            }
            float *warped = take_floats(3 * pixel_count(v));
            dist_photo to = photo_of(v);
            dist_photo from = photo_of(&f->views[v->neighbor[0]]);
            dist_photometric_desc desc;
            memset(&desc, 0, sizeof desc);
            desc.warped = warped;
            dist_loss_photometric(&to, &from, &desc, 1.0f, NULL, NULL);
            *picture = picture_color(v->camera.width, v->camera.height, row == 0 ? v->photo : warped);
            canvas_enlarge(picture, zoom);
            free(warped);
        }
    }
    canvas sheet = picture_sheet(count, pictures, captions, SHOWN);
    printf("%s\n", write_canvas(f->asked->out, &sheet));
    for (int i = 0; i < count; i++) { canvas_destroy(&pictures[i]); }
    fit_set(f, &f->now);
}

static void write_loss(const request *o, const double *loss)
{
    static const char *const names[] = {"loss", "photometric", "code prior"};
    size_t n = (size_t)o->iterations;
    double *columns = (double *)take(3 * n, sizeof *columns);
    curve curves[3];
    char path[PATH_SIZE];
    for (size_t k = 0; k < 3; k++) {
        for (size_t i = 0; i < n; i++) { columns[k * n + i] = loss[3 * i + k]; }
        curves[k].name = names[k];
        curves[k].n = n;
        curves[k].x = NULL;
        curves[k].y = columns + k * n;
    }
    path_of(path, o->out, "_loss.svg");
    write_curves(path, "loss of the fit", "step", "weighted loss", 3, curves, 1);
    printf("%s\n", path);
    free(columns);
}

static void write_report(const fit *f, const float *chamfers, int trials, int good, const score scores[2],
                         double seconds)
{
    static const char *const when[] = {"start", "end"};
    const request *o = f->asked;
    char path[PATH_SIZE];
    json j = json_open(path_of(path, o->out, ".json"));
    json_text(&j, "model", o->model);
    json_text(&j, "photos", o->photos ? o->photos : "taken of the model");
    if (!o->photos) { json_text(&j, "texture", o->texture); }
    for (int i = 0; i < 2; i++) {
        json_score(&j, "loss", when[i], scores[i].loss);
        json_score(&j, "depth_error", when[i], scores[i].depth_error);
        json_score(&j, "iou", when[i], scores[i].iou);
        json_score(&j, "chamfer", when[i], scores[i].chamfer);
    }
    json_count(&j, "trials", (unsigned long long)trials);
    if (!o->photos) { json_count(&j, "trials_good", (unsigned long long)good); } /* else the truth is not known */
    json_floats(&j, "chamfer_starts", (size_t)trials, chamfers);
    json_floats(&j, "chamfer_ends", (size_t)trials, chamfers + trials);
    json_count(&j, "queries", f->queries);
    json_number(&j, "seconds", seconds);
    json_count(&j, "iterations", (unsigned long long)o->iterations);
    json_count(&j, "views", f->view_count);
    json_count(&j, "batch", (unsigned long long)o->batch);
    json_floats(&j, "weights", 2, o->weights);
    json_number(&j, "rate", (double)o->rate);
    json_number(&j, "ssim", (double)o->ssim);
    json_number(&j, "blur", (double)o->blur);
    json_text(&j, "gradient", o->gradient == GRADIENT_MESH ? "mesh" : gradient_name(o->gradient));
    if (f->scene) {
        json_number(&j, "scale", (double)f->now.place.scale);
        json_floats(&j, "rotation", 9, f->now.place.rotation);
        json_floats(&j, "translation", 3, f->now.place.translation);
    }
    json_floats(&j, "code", f->code_size, f->now.code);
    json_close(&j);
    printf("%s\n", path);
}

/* ---- program ----------------------------------------------------------------------------------------------------- */

static request read_options(int argc, char **argv)
{
    static const char *const gradients[] = {"auto", "implicit", "normal", "paper", "mesh", NULL};
    static const char *const backgrounds[] = {"sky", "plain", NULL};
    request r;
    memset(&r, 0, sizeof r);
    r.views = 24;
    r.batch = 8;
    r.iterations = 64;
    r.rate = 0.01f;
    r.weights[0] = 5.0f;
    r.weights[1] = 1.0f;
    r.blur = 4.0f;
    r.fov = 45.0f;
    r.off[0] = 100.0f; /* not given */
    r.place[0] = 1.0f;
    int taken = 0;
    options walk = options_begin(argc, argv, usage);
    while (option_next(&walk)) {
        if (option_is_word(&walk) && !r.model) {
            r.model = argv[walk.index];
        } else if (option_is(&walk, "--target")) {
            r.target = option_text(&walk);
        } else if (option_is(&walk, "--photos")) {
            r.photos = option_text(&walk);
        } else if (option_is(&walk, "--save")) {
            r.save = option_text(&walk);
        } else if (option_is(&walk, "--texture")) {
            r.texture = option_text(&walk);
        } else if (option_is(&walk, "--color-code")) {
            r.color_code = option_int(&walk, 0, 1000000);
        } else if (option_is(&walk, "--similarity")) {
            r.similarity = option_flag(&walk);
        } else if (option_is(&walk, "--off")) {
            option_floats(&walk, 3, r.off);
            if (!(r.off[0] > -99.0f && r.off[0] < 99.0f)) { fail("--off must stay below 99 percent"); }
        } else if (option_is(&walk, "--place")) {
            option_floats(&walk, 4, r.place);
        } else if (option_is(&walk, "--views")) {
            r.views = option_int(&walk, 2, 1000);
            taken = 1;
        } else if (option_is(&walk, "--size")) {
            option_size(&walk, &r.width, &r.height);
        } else if (option_is(&walk, "--fov")) {
            r.fov = (float)option_number(&walk, 0.1, 175.0);
            taken = 1;
        } else if (option_is(&walk, "--background")) {
            r.plain = option_choice(&walk, backgrounds);
            taken = 1;
        } else if (option_is(&walk, "--batch")) {
            r.batch = option_int(&walk, 2, 1000);
        } else if (option_is(&walk, "--start")) {
            r.start = option_text(&walk);
        } else if (option_is(&walk, "--iterations")) {
            r.iterations = option_int(&walk, 1, 1000000);
        } else if (option_is(&walk, "--rate")) {
            r.rate = (float)option_number(&walk, 1e-9, 1e3);
        } else if (option_is(&walk, "--weights")) {
            option_floats(&walk, 2, r.weights);
            option_weights(&walk, 2, r.weights);
        } else if (option_is(&walk, "--ssim")) {
            r.ssim = (float)option_number(&walk, 0, 1);
        } else if (option_is(&walk, "--blur")) {
            r.blur = (float)option_number(&walk, 0, 12);
        } else if (option_is(&walk, "--gradient")) {
            r.gradient = option_choice(&walk, gradients);
        } else if (option_is(&walk, "--mesh-cells")) {
            r.cells = option_int(&walk, 8, 256);
        } else if (option_is(&walk, "--trials")) {
            r.trials = option_int(&walk, 1, 10000);
        } else if (option_is(&walk, "--threads")) {
            r.settings.workers = option_int(&walk, 1, 1024);
        } else if (option_is(&walk, "--out")) {
            r.out = option_text(&walk);
        } else {
            option_unknown(&walk);
        }
    }
    if (!r.out) { fail("--out STEM is needed: where the results go"); }
    if (r.photos && r.target) { fail("--photos and --target are two observations; give one"); }
    if (r.photos && r.save) { fail("--save writes photos that were taken, not those of --photos"); }
    if (r.trials && r.start) { fail("--trials begins from random:1, random:2 ...; leave out --start"); }
    if (r.trials && r.photos) { fail("--trials needs a known shape; leave out --photos"); }
    if (r.weights[0] < 0 || r.weights[1] < 0) { fail("--weights must not be negative"); }
    option_belongs(r.photos && (taken || r.width), "--views, --size, --fov and --background",
                   "are of photos that are taken, not of --photos");
    option_belongs(r.photos && (r.texture || r.color_code), "--texture and --color-code",
                   "are of photos that are taken, not of --photos");
    option_belongs(r.off[0] < 100.0f && !r.similarity, "--off", "is where --similarity starts, which is not given");
    option_belongs(r.off[0] < 100.0f && r.photos, "--off", "is where fits to photos that are taken start; say --place");
    option_belongs(r.cells && r.gradient != GRADIENT_MESH, "--mesh-cells", "belongs to --gradient mesh");
    if (r.off[0] >= 100.0f) { r.off[0] = r.off[1] = 10.0f, r.off[2] = 0.1f; }
    if (!r.cells) { r.cells = 48; }
    if (!r.width) { r.width = r.height = 112; }
    int placed = r.place[0] != 1.0f || r.place[1] != 0.0f || r.place[2] != 0.0f || r.place[3] != 0.0f;
    if (placed && !(r.photos && r.similarity)) { fail("--place belongs to --photos with --similarity"); }
    if (!(r.place[0] > 0)) { fail("--place needs a scale above 0"); }
    if (!r.model) { r.model = "embedded"; }
    if (!r.texture) { r.texture = strcmp(r.model, "embedded") == 0 ? "embedded" : "waves"; }
    check_stem(r.out);
    return r;
}

/* Photos of the target and points on its surface. */
static void observe(fit *f, const dist_net *net, const float *code)
{
    const request *o = f->asked;
    dist_shape *truth = dist_shape_create(f->ctx, net, code);
    dist_net *texture = strcmp(o->texture, "waves") == 0 ? NULL : load_texture(f->ctx, o->texture);
    if (texture) {
        if ((size_t)dist_net_code_size(texture) < f->code_size) {
            fail("%s is the texture of another model", o->texture);
        }
        if (o->color_code >= dist_net_code_count(texture)) {
            fail("--color-code is %d; %s has %d colorings", o->color_code, o->texture, dist_net_code_count(texture));
        }
        dist_shape_set_texture(truth, texture, dist_net_code(texture, o->color_code) + f->code_size);
    }
    check(f->ctx);
    dist_field field = dist_shape_field(truth);
    take_photos(f, &field);
    dist_mesh_destroy(surface_of(f->ctx, &field, &f->target_points));
    if (!f->target_points) { fail("the target has no surface"); }
    dist_shape_destroy(truth);
    dist_net_destroy(texture);
}

static fit fit_create(const request *o, const dist_net *net, dist_context *ctx, const float *target)
{
    fit f;
    memset(&f, 0, sizeof f);
    f.asked = o;
    f.ctx = ctx;
    f.code_size = (size_t)dist_net_code_size(net);
    if (f.code_size == 0) { fail("%s has no code, so there is nothing to fit", o->model); }
    f.d_code = take_floats(f.code_size + 7);
    f.how.gradient = o->gradient == GRADIENT_MESH ? DIST_GRADIENT_AUTO : o->gradient;
    f.shape = dist_shape_create(ctx, net, NULL);
    f.field = dist_shape_field(f.shape);
    if (o->similarity) {
        dist_instance instance;
        memset(&instance, 0, sizeof instance);
        instance.field = &f.field;
        f.scene = dist_scene_create(ctx, 1, &instance);
    }
    check(ctx);
    if (o->photos) {
        read_photos(&f);
    } else {
        observe(&f, net, target);
    }
    if (o->save) { save_photos(&f); }
    find_neighbors(&f);
    return f;
}

static void fit_destroy(fit *f)
{
    for (size_t i = 0; i < f->view_count; i++) {
        view_data *v = &f->views[i];
        free(v->photo);
        free(v->color);
        free(v->depth);
        free(v->d_depth);
        free(v->mask);
        free(v->true_depth);
        free(v->true_mask);
        free(v->triangle);
        dist_tape_destroy(v->tape);
    }
    free(f->views);
    free(f->now.code);
    free(f->d_code);
    free(f->target_points);
    dist_scene_destroy(f->scene);
    dist_shape_destroy(f->shape);
}

static void print_result(const fit *f, const char *name, const score scores[2], const state *start, double seconds)
{
    printf("%s: loss %.4f -> %.4f", name, scores[0].loss, scores[1].loss);
    if (f->target_points) {
        printf("  Chamfer (x 1000, truth to shape)");
        for (int i = 0; i < 2; i++) {
            printf(scores[i].chamfer < 0 ? "%s none" : "%s %.3f", i ? " ->" : "", 1000 * scores[i].chamfer);
        }
    }
    if (f->scene && f->target_points) {
        float error[2][3];
        place_error(&start->place, error[0]);
        place_error(&f->now.place, error[1]);
        printf("  scale %.1f -> %.1f %%, turn %.1f -> %.1f deg, place %.3f -> %.3f", (double)error[0][0],
               (double)error[1][0], (double)error[0][1], (double)error[1][1], (double)error[0][2], (double)error[1][2]);
    }
    printf("  %.1f s\n", seconds);
    fflush(stdout);
}

int main(int argc, char **argv)
{
    request r = read_options(argc, argv);
    dist_context *ctx = dist_context_create(&r.settings);
    dist_net *net = load_model(ctx, r.model);
    state target;
    state start;
    memset(&target, 0, sizeof target);
    memset(&start, 0, sizeof start);
    target.code = r.photos ? NULL : choose_code(net, r.target);
    fit f = fit_create(&r, net, ctx, target.code);
    double *loss = (double *)take(3 * (size_t)r.iterations, sizeof(double));
    int trials = r.trials ? r.trials : 1;
    int good = 0;
    float *chamfers = take_floats(2 * (size_t)trials); /* of the starts, of the ends; NaN: none */
    score scores[2];
    double seconds = 0;
    for (int t = 0; t < trials; t++) {
        char text[64];
        snprintf(text, sizeof text, "random:%d", t + 1);
        const char *name = r.start ? r.start : text;
        free(f.now.code);
        free(start.code);
        start.code = choose_code(net, name);
        start.place = start_place(&r, t);
        f.now.code = choose_code(net, name);
        f.now.place = start.place;
        scores[0] = fit_score(&f);
        size_t compared = f.compared;
        if (compared == 0 && !r.trials) {
            fail("no photo shows anything of the start that its neighbor shows: nothing to fit");
        }
        unsigned long long scored = f.queries;
        double begin = seconds_now();
        fit_run(&f, loss);
        seconds = seconds_now() - begin;
        unsigned long long queries = f.queries - scored;
        scores[1] = fit_score(&f);
        f.queries = queries;
        for (int i = 0; i < 2; i++) { chamfers[i * trials + t] = scores[i].chamfer < 0 ? NAN : (float)scores[i].chamfer; }
        good += scores[0].chamfer > 0 && scores[1].chamfer >= 0 && 3 * scores[1].chamfer <= scores[0].chamfer;
        print_result(&f, name, scores, &start, seconds);
        tell_if_not_fallen(scores[0].loss, scores[1].loss, (double)r.rate);
        if (4 * f.compared < compared) {
            printf("of the %.0f pixels that were compared at the start %.0f are left: the shape has left the photos\n",
                   (double)compared, (double)f.compared);
        }
    }
    if (r.trials) { printf("%d of %d end at a third of the start's Chamfer or less\n", good, trials); }
    write_report(&f, chamfers, trials, good, scores, seconds);

    char path[PATH_SIZE];
    dist_mesh *mesh = dist_mesh_extract(ctx, &f.field, NULL);
    dist_mesh_save(ctx, mesh, path_of(path, r.out, ".ply"));
    check(ctx);
    printf("%s\n", path);
    dist_mesh_destroy(mesh);
    write_loss(&r, loss);
    write_sheet(&f, &start, &target);
    free(start.code);
    free(target.code);
    free(chamfers);
    free(loss);
    fit_destroy(&f);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
