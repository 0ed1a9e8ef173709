/* SPDX-License-Identifier: MIT-0
   fit.h - what the fitting examples share: their options, the observation, the scores, the strip of pictures.
   The examples' code, not the library's. Include it after common.h. */
#ifndef DIST_EXAMPLES_FIT_H
#define DIST_EXAMPLES_FIT_H

/* ---- options ----------------------------------------------------------------------------------------------------- */

typedef struct fit_options {
    const char *model, *target, *depth_path, *mask_path, *out;
    view view; /* width 0: not given */
    int no_mask;
    double keep; /* percent of the hit pixels that are seen */
    int points;  /* or their number; 0: keep counts */
    int seed;
    int iterations;
    float rate;
    float weights[3]; /* depth, silhouette, prior */
    dist_render_desc how;
    dist_context_desc settings;
} fit_options;

#define FIT_USAGE                                                                                     \
    "  MODEL              a safetensors file, or the word embedded (default)\n"                       \
    "  --target WHICH     what is seen: a shape of the model, by INDEX or a code's FILE (default 0)\n" \
    "  --depth FILE.pfm   or: a depth image; 0, infinity or above 1e5 where nothing is seen\n"        \
    "  --mask FILE.pfm    its silhouette, not 0 inside (default: where there is depth)\n"             \
    "  --no-mask          use no silhouette\n" VIEW_USAGE                                             \
    "  --keep PERCENT     of the pixels with depth, keep this many, chosen by chance (default 100)\n" \
    "  --points N         or: keep N of them\n"                                                       \
    "  --seed S           of that choice (default 1)\n"                                               \
    "  --iterations N     steps of Adam (default 100)\n"                                              \
    "  --rate R           its rate (default 0.01)\n"                                                  \
    "  --weights D,S,P    of depth, silhouette and code prior (default 10,1,1)\n"                     \
    "  --gradient WHICH   paper (default), implicit, normal or auto; see the README\n"               \
    "  --trace WHICH      guarded (default) or paper\n"                                               \
    "  --samples K        samples a ray of the paper's gradient, 1 to 8 (default 2)\n"                \
    "  --threads N        threads to use at most (default all)\n"                                     \
    "  --out STEM         files written: STEM.png, STEM_loss.svg, STEM.ply, STEM.json\n"

static inline fit_options fit_defaults(void)
{
    fit_options f;
    memset(&f, 0, sizeof f);
    f.view = view_default(0, 0);
    f.keep = 100.0;
    f.seed = 1;
    f.iterations = 100;
    f.how.gradient = DIST_GRADIENT_PAPER; /* with two samples: see the README's table */
    f.how.samples = 2;
    f.rate = 0.01f;
    f.weights[0] = 10.0f;
    f.weights[1] = 1.0f;
    f.weights[2] = 1.0f;
    return f;
}

/* 1 if the option was one of these. */
static inline int option_fit(options *o, fit_options *f)
{
    static const char *const gradients[] = {"auto", "implicit", "normal", "paper", NULL};
    static const char *const tracers[] = {"guarded", "paper", NULL};
    if (option_is_word(o) && !f->model) {
        f->model = o->argv[o->index];
    } else if (option_is(o, "--target")) {
        f->target = option_text(o);
    } else if (option_is(o, "--depth")) {
        f->depth_path = option_text(o);
    } else if (option_is(o, "--mask")) {
        f->mask_path = option_text(o);
    } else if (option_is(o, "--no-mask")) {
        f->no_mask = option_flag(o);
    } else if (option_is(o, "--keep")) {
        f->keep = option_number(o, 1e-6, 100.0);
    } else if (option_is(o, "--points")) {
        f->points = option_int(o, 1, 1 << 28);
    } else if (option_is(o, "--seed")) {
        f->seed = option_int(o, 0, 2147483647);
    } else if (option_is(o, "--iterations")) {
        f->iterations = option_int(o, 1, 1000000);
    } else if (option_is(o, "--rate")) {
        f->rate = (float)option_number(o, 1e-9, 1e3);
    } else if (option_is(o, "--weights")) {
        option_floats(o, 3, f->weights);
        option_weights(o, 3, f->weights);
    } else if (option_is(o, "--gradient")) {
        f->how.gradient = option_choice(o, gradients);
    } else if (option_is(o, "--trace")) {
        f->how.trace = option_choice(o, tracers);
    } else if (option_is(o, "--samples")) {
        f->how.samples = option_int(o, 1, 8);
    } else if (option_is(o, "--threads")) {
        f->settings.workers = option_int(o, 1, 1024);
    } else if (option_is(o, "--out")) {
        f->out = option_text(o);
    } else {
        return option_view(o, &f->view);
    }
    return 1;
}

/* What contradicts itself is said before anything is computed. */
static inline void check_fit_options(const fit_options *f)
{
    if (f->depth_path && f->target) { fail("--depth and --target are two observations; give one"); }
    if (f->no_mask && !(f->weights[0] > 0.0f)) {
        fail("--no-mask and a weight of 0 for the depth leave nothing to fit");
    }
    if (f->mask_path && f->no_mask) { fail("--mask and --no-mask contradict each other"); }
    if (f->points && f->keep < 100.0) { fail("--keep and --points are two ways to choose the pixels; give one"); }
    for (int i = 0; i < 3; i++) {
        if (f->weights[i] < 0.0f) { fail("--weights must not be negative, got %g", (double)f->weights[i]); }
    }
}

static inline const char *gradient_name(int gradient)
{
    static const char *const names[] = {"auto", "implicit", "normal", "paper"};
    return names[gradient];
}

/* ---- observation ------------------------------------------------------------------------------------------------- */

/* What the camera has seen. The full picture is kept for the scores; the fit gets `seen` and perhaps `mask`. */
typedef struct observation {
    int width, height;
    size_t n, hits, seen_count;
    float *depth;        /* 0 at a miss */
    canvas truth;        /* shaded; without pixels if it came from a file */
    unsigned char *mask; /* 1 where the shape is */
    float *seen;         /* depth of the pixels kept, 0 elsewhere */
} observation;

static inline observation observation_create(int width, int height)
{
    observation s;
    memset(&s, 0, sizeof s);
    s.width = width;
    s.height = height;
    s.n = (size_t)width * (size_t)height;
    s.depth = take_floats(s.n);
    s.seen = take_floats(s.n);
    s.mask = (unsigned char *)take(s.n, 1);
    return s;
}

static inline void observation_destroy(observation *s)
{
    free(s->depth);
    canvas_destroy(&s->truth);
    free(s->seen);
    free(s->mask);
}

/* A clay picture of a field, large enough to look at. */
static inline canvas picture_field(dist_context *ctx, const dist_field *field, const dist_camera *camera)
{
    dist_camera zoomed = zoom_camera(camera, picture_zoom(camera->width, camera->height));
    size_t n = (size_t)zoomed.width * (size_t)zoomed.height;
    dist_images out;
    memset(&out, 0, sizeof out);
    out.normal = take_floats(3 * n);
    out.mask = (unsigned char *)take(n, 1);
    dist_render(ctx, field, &zoomed, NULL, &out, NULL);
    check(ctx);
    canvas picture = picture_shaded(zoomed.width, zoomed.height, out.normal, out.mask, NULL);
    free(out.normal);
    free(out.mask);
    return picture;
}

/* The depth image that the library itself takes of a field, a network's or any other. */
static inline observation observe_field(dist_context *ctx, const dist_field *field, const dist_camera *camera)
{
    observation s = observation_create(camera->width, camera->height);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = s.depth;
    out.mask = s.mask;
    dist_render(ctx, field, camera, NULL, &out, NULL);
    check(ctx);
    for (size_t i = 0; i < s.n; i++) {
        if (!s.mask[i]) { s.depth[i] = 0.0f; } /* an unresolved ray's depth is no observation */
    }
    s.truth = picture_field(ctx, field, camera);
    return s;
}

static inline float *load_plane(dist_context *ctx, const char *path, int *width, int *height)
{
    int channels = 0;
    float *plane = dist_pfm_load(ctx, path, width, height, &channels);
    check(ctx);
    if (channels != 1) { fail("%s has %d channels; a depth or mask image has one", path, channels); }
    return plane;
}

static inline int is_depth(float depth)
{
    return depth > 0.0f && depth < 1e5f;
}

/* --mask, if it is given, in place of where the depth is. */
static inline void observe_mask(dist_context *ctx, const char *path, observation *s)
{
    if (!path) { return; }
    int width = 0;
    int height = 0;
    float *mask = load_plane(ctx, path, &width, &height);
    if (width != s->width || height != s->height) {
        fail("%s is %d x %d, but the depth image is %d x %d", path, width, height, s->width, s->height);
    }
    for (size_t i = 0; i < s->n; i++) {
        s->mask[i] = mask[i] > 0.0f || mask[i] < 0.0f;
    }
    dist_pfm_free(ctx, mask, width, height, 1);
}

/* --depth. The view gets its size. */
static inline observation observe_file(dist_context *ctx, fit_options *o)
{
    const char *depth_path = o->depth_path;
    int width = 0;
    int height = 0;
    float *depth = load_plane(ctx, depth_path, &width, &height);
    if (o->view.width && (width != o->view.width || height != o->view.height)) {
        fail("--size is %d x %d, but %s is %d x %d", o->view.width, o->view.height, depth_path, width, height);
    }
    o->view.width = width;
    o->view.height = height;
    observation s = observation_create(width, height);
    for (size_t i = 0; i < s.n; i++) {
        s.mask[i] = is_depth(depth[i]) ? 1 : 0;
        s.depth[i] = s.mask[i] ? depth[i] : 0.0f;
    }
    dist_pfm_free(ctx, depth, width, height, 1);
    return s;
}

/* Keeps some of the pixels with depth: `points` of them, or `percent` if points is 0. */
static inline void observation_keep(observation *s, double percent, int points, unsigned seed)
{
    size_t *pixels = (size_t *)take(s->n, sizeof *pixels);
    size_t count = 0;
    for (size_t i = 0; i < s->n; i++) {
        if (s->mask[i] && is_depth(s->depth[i])) { pixels[count++] = i; }
    }
    if (count == 0) { fail("the observation has no pixel with depth in its mask, so there is nothing to fit"); }
    size_t wanted = points ? (size_t)points : (size_t)((double)count * percent / 100.0 + 0.5);
    s->hits = count;
    s->seen_count = wanted < 1 ? 1 : wanted > count ? count : wanted;
    rng r = rng_begin(seed);
    for (size_t i = 0; i < s->seen_count; i++) {
        size_t other = i + rng_index(&r, count - i);
        size_t pixel = pixels[other];
        pixels[other] = pixels[i];
        s->seen[pixel] = s->depth[pixel];
    }
    free(pixels);
}

/* ---- scores ------------------------------------------------------------------------------------------------------ */

/* Below 0: not known. */
typedef struct score {
    double loss;
    double depth_error; /* mean |difference| over the pixels that both hit, seen or not */
    double iou;         /* of the two masks */
    double chamfer;     /* as DeepSDF defines it: squared distances, both ways */
} score;

/* Two pictures beside each other, or pairs of them in turn: sums over their pixels. */
typedef struct agreement {
    double difference, compared, both, either;
} agreement;

static inline void agreement_add(agreement *o, size_t n, const float *seen, const unsigned char *seen_mask,
                                 const float *depth, const unsigned char *mask)
{
    for (size_t i = 0; i < n; i++) {
        o->both += seen_mask[i] && mask[i];
        o->either += seen_mask[i] || mask[i];
        if (!seen_mask[i] || !mask[i] || !is_depth(seen[i])) { continue; }
        o->difference += fabs((double)depth[i] - (double)seen[i]);
        o->compared += 1;
    }
}

static inline score agreement_score(const agreement *o)
{
    score result;
    result.loss = -1;
    result.depth_error = o->compared > 0 ? o->difference / o->compared : -1;
    result.iou = o->either > 0 ? o->both / o->either : -1;
    result.chamfer = -1;
    return result;
}

static inline score score_pictures(const observation *s, const float *depth, const unsigned char *mask)
{
    agreement o = {0, 0, 0, 0};
    agreement_add(&o, s->n, s->depth, s->mask, depth, mask);
    return agreement_score(&o);
}

enum { SURFACE_POINTS = 30000 };

/* The field's surface as triangles and as points spread evenly over it; no points if there is no surface. */
static inline dist_mesh *surface_of(dist_context *ctx, const dist_field *field, float **points)
{
    dist_mesh_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.resolution = 96;
    desc.refine = 1;
    dist_mesh *mesh = dist_mesh_extract(ctx, field, &desc);
    check(ctx);
    *points = NULL;
    if (mesh->triangle_count == 0) { return mesh; }
    *points = take_floats(3 * SURFACE_POINTS);
    dist_mesh_sample(ctx, mesh, 1, SURFACE_POINTS, *points);
    check(ctx);
    return mesh;
}

/* -1 if one of the two surfaces is empty. */
static inline double chamfer_between(dist_context *ctx, const float *a, const float *b)
{
    double chamfer = -1;
    if (!a || !b) { return chamfer; }
    dist_chamfer(ctx, SURFACE_POINTS, a, SURFACE_POINTS, b, &chamfer, NULL);
    check(ctx);
    return chamfer;
}

/* A word at the end of a fit that has found nothing better than its start, if that was not the truth to the last bits. */
static inline void tell_if_not_fallen(double start, double end, double rate)
{
    if (!(end < start) && !(end < 1e-5)) { printf("the loss has not fallen: try a --rate below %g, or another start\n", rate); }
}

static inline void json_score(json *j, const char *name, const char *when, double value)
{
    char key[64];
    snprintf(key, sizeof key, "%s_%s", name, when);
    if (value < 0 && strcmp(name, "loss") != 0) {
        json_null(j, key);
    } else {
        json_number(j, key, value);
    }
}

/* ---- pictures ---------------------------------------------------------------------------------------------------- */

/* What the fit gets to see: pixels kept in full color, the rest of the silhouette (if it is used) as a pale shadow. */
static inline canvas picture_seen(const observation *s, int show_mask)
{
    float range[2];
    depth_range(s->n, s->depth, s->mask, range);
    canvas c = canvas_create(s->width, s->height, 0.0f);
    paint_background(&c);
    for (int i = 0; i < s->width * s->height; i++) {
        int x = i % s->width;
        int y = i / s->width;
        float rgb[3];
        if (s->seen[i] > 0.0f) {
            color_viridis(1.0f - 0.95f * (s->seen[i] - range[0]) / (range[1] - range[0] + 1e-9f), rgb);
            canvas_set(&c, x, y, rgb[0], rgb[1], rgb[2]);
        } else if (s->mask[i] && show_mask) {
            canvas_set(&c, x, y, 0.70f, 0.71f, 0.73f);
        }
    }
    return c;
}

#endif
